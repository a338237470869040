"""The parameters of the recorder."""

from hmsa_ros.bag.output import PRESETS
from hmsa_ros.nodes import interface
from hmsa_ros.nodes.parameters import ParameterSpec

PARAMETERS = (
    ParameterSpec(
        'storage.uri', '',
        'Folder of the bag, which must not exist; empty for a name with date and time.'),
    ParameterSpec(
        'storage.storage_preset_profile', 'none',
        'Compression: none, fastwrite (none, without checksums), lz4, zstd_fast or zstd_small.',
        choices=tuple(PRESETS)),
    ParameterSpec(
        'storage.max_bagfile_size', 0,
        'Size at which a new file is begun, 0 for never, else at least 1024.', 'B', 0),
    ParameterSpec(
        'storage.max_bagfile_duration', 0,
        'Time span at which a new file is begun, 0 for never.', 's', 0),
    ParameterSpec(
        'storage.max_cache_size', 100 * 2**20,
        'Memory for messages that wait to be written; what comes on top is counted as lost.',
        'B', 2**16),
    ParameterSpec(
        'storage.custom_data', [], 'Pairs key=value that are stored in the bag.'),
    ParameterSpec(
        'storage.flush_period', 0.5,
        'Time after which at the latest a message survives the end of the process.', 's',
        0.01, 3600.0),
    ParameterSpec(
        'storage.fsync', False,
        'Whether each flush waits for the disk, so that messages survive a power cut too.'),
    ParameterSpec(
        'record.topics', [],
        'Topics to record; with no selection at all, every topic is recorded.'),
    ParameterSpec('record.all_topics', False, 'Whether to record every topic.'),
    ParameterSpec(
        'record.regex', '', 'Topics in which this regular expression is found are recorded.'),
    ParameterSpec('record.exclude_topics', [], 'Topics not to record.'),
    ParameterSpec(
        'record.exclude_regex', '',
        'Topics in which this regular expression is found are not recorded.'),
    ParameterSpec('record.start_paused', False, 'Whether to begin paused.'),
    ParameterSpec(
        'record.topic_polling_interval.sec', 0, 'Whole seconds between looks for new topics.',
        's', 0, 3600),
    ParameterSpec(
        'record.topic_polling_interval.nsec', 100_000_000, 'Nanoseconds on top of them.', 'ns',
        0, 999_999_999),
    ParameterSpec(
        'record.queue_depth', 10_000,
        'Messages of a topic that the middleware keeps until they are taken.', '', 1, 1_000_000),
    ParameterSpec(
        'record.snapshot_mode', False,
        'Whether messages are only kept in memory until ~/snapshot is called.'),
    ParameterSpec(
        'record.snapshot_duration', 10.0, 'Time that a snapshot reaches back.', 's', 1e-3, 1e6),
    ParameterSpec(
        'experiment.nodes', [interface.PLANNER, interface.PLANT],
        'Nodes whose parameters are stored in the bag; a name without slash is that of a node '
        'in any namespace.'),
)
