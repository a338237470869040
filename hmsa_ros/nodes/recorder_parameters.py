"""The parameters of the recorder."""

from hmsa_ros.bag.output import PRESETS
from hmsa_ros.contract import topics
from hmsa_ros.contract.parameters import ParameterSpec

PARAMETERS = (
    ParameterSpec(
        'storage.uri', '',
        'Folder of the new bag, which must not exist yet; empty for a name with date and time.'),
    ParameterSpec(
        'storage.storage_preset_profile', 'none',
        'Compression: none, fastwrite (none, without checksums), lz4, zstd_fast or zstd_small.',
        choices=tuple(PRESETS)),
    ParameterSpec(
        'storage.max_bagfile_size', 0,
        'File size at which the bag is split; 0 for never, otherwise at least 1024.', 'B', 0),
    ParameterSpec(
        'storage.max_bagfile_duration', 0,
        'Duration after which the bag is split; 0 for never.', 's', 0),
    ParameterSpec(
        'storage.max_cache_size', 100 * 2**20,
        'Memory for messages waiting to be written; messages beyond it are counted as lost.',
        'B', 2**16),
    ParameterSpec(
        'storage.custom_data', [], 'Pairs key=value to store in the bag.'),
    ParameterSpec(
        'storage.flush_period', 0.5,
        'Longest time until a received message survives a crash of the process.', 's',
        0.01, 3600.0),
    ParameterSpec(
        'storage.fsync', False,
        'Whether each flush waits for the disk, so that messages also survive a power failure.'),
    ParameterSpec(
        'record.topics', [],
        'Topics to record; with no selection at all, every topic is recorded.'),
    ParameterSpec('record.all_topics', False, 'Whether to record every topic.'),
    ParameterSpec(
        'record.regex', '', 'Regular expression; topics that contain a match are recorded.'),
    ParameterSpec('record.exclude_topics', [], 'Topics not to record.'),
    ParameterSpec(
        'record.exclude_regex', '',
        'Regular expression; topics that contain a match are not recorded.'),
    ParameterSpec('record.start_paused', False, 'Whether to start paused.'),
    ParameterSpec(
        'record.topic_polling_interval.sec', 0, 'Whole seconds between searches for new topics.',
        's', 0, 3600),
    ParameterSpec(
        'record.topic_polling_interval.nsec', 100_000_000, 'Nanoseconds to add to the seconds.',
        'ns',
        0, 999_999_999),
    ParameterSpec(
        'record.queue_depth', 10_000,
        'Queue depth of each subscription in the middleware.', '', 1, 1_000_000),
    ParameterSpec(
        'record.snapshot_mode', False,
        'Whether to keep messages only in memory until ~/snapshot is called.'),
    ParameterSpec(
        'record.snapshot_duration', 10.0, 'How far back a snapshot reaches.', 's', 1e-3, 1e6),
    ParameterSpec(
        'experiment.nodes', [topics.PLANNER, topics.PLANT],
        'Nodes whose parameters are stored in the bag; a name without a slash matches nodes in '
        'any namespace.'),
)
