"""The bag's format, compared with independent readers."""

from pathlib import Path
import random

from extras import needs
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
import pytest

from hmsa.bag import metadata, qos
from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.info import summarize, to_text
from hmsa.bag.reader import BagReader, read_messages
from hmsa.bag.writer import BagTopic, BagWriter, parse_custom_data, PRESETS
from hmsa.errors import BadInputError, BagError

AnyReader = needs('rosbags.highlevel').AnyReader
rosbag2, typesys = needs('rosbags.rosbag2'), needs('rosbags.typesys')
STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
FLOAT = 'std_msgs/msg/Float64'
TYPES = (
    FLOAT, 'sensor_msgs/msg/MagneticField', 'sensor_msgs/msg/JointState',
    'trajectory_msgs/msg/JointTrajectory', 'diagnostic_msgs/msg/DiagnosticArray',
    'rosgraph_msgs/msg/Clock', 'rcl_interfaces/msg/ParameterEvent')
PROFILES = (qos.Qos(), qos.Qos(durability='transient_local', reliability='best_effort'))


def payload(value):
    return bytes(STORE.serialize_cdr(STORE.types[FLOAT](data=float(value)), FLOAT))


def topic(name='/a', type_name=FLOAT, profiles=PROFILES[:1]):
    encoding, text = message_definition(type_name)
    return BagTopic(name, type_name, text, encoding, tuple(profiles), type_hash(type_name))


def write_bag(folder, stamps=range(10), **options):
    with BagWriter(folder, **options) as writer:
        number = writer.add_topic(topic())
        writer.write((number, stamp, stamp + 5, i, payload(i))
                     for i, stamp in enumerate(stamps))
    return folder


@pytest.mark.parametrize('type_name', TYPES)
def test_type_hashes_and_definitions_agree_with_rosbags(type_name):
    assert type_hash(type_name) == STORE.hash_rihs01(type_name)
    encoding, text = message_definition(type_name)
    assert encoding == 'ros2msg'
    parsed = typesys.get_types_from_msg(text, type_name)
    assert all(parsed[name] == STORE.fielddefs[name] for name in parsed)


@pytest.mark.parametrize('preset', PRESETS)
def test_other_readers_get_the_same_messages(tmp_path, preset):
    folder = write_bag(tmp_path / 'bag', range(10**9, 10**9 + 5000), preset=preset,
                       chunk_size=10_000, custom_data={'key': 'a value: with colon'})
    with AnyReader([folder]) as reader:
        assert reader.message_count == 5000
        assert [reader.deserialize(data, connection.msgtype).data
                for connection, _, data in reader.messages()] == list(range(5000))
    assert needs('ruamel.yaml').YAML(typ='safe').load(folder / 'metadata.yaml')[
        'rosbag2_bagfile_information']['custom_data'] == {'key': 'a value: with colon'}
    with rosbag2.Reader(folder) as reader:
        connection, = reader.connections
        assert connection.digest == type_hash(FLOAT)
        assert connection.ext.offered_qos_profiles[0].reliability.name == 'RELIABLE'
    with (folder / 'bag_0.mcap').open('rb') as file:
        messages = [message for _, _, message in make_reader(
            file, validate_crcs=True).iter_messages()]
    assert [(message.log_time, message.publish_time) for message in messages] == [
        (stamp, stamp + 5) for stamp in range(10**9, 10**9 + 5000)]
    with (folder / 'bag_0.mcap').open('rb') as file:
        for _ in StreamReader(file, validate_crcs=True).records:
            pass


def test_the_summary_counts_everything(tmp_path):
    folder = write_bag(tmp_path / 'bag', range(2000), chunk_size=1000)
    with (folder / 'bag_0.mcap').open('rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert [record.name for record in reader.iter_metadata()] == [
            'rosbag2', 'hmsa_ros', 'rosbag2']
        assert reader.get_header().profile == 'ros2'
    statistics = summary.statistics
    assert statistics.message_count == 2000
    assert statistics.chunk_count == len(summary.chunk_indexes)
    assert statistics.channel_message_counts == {1: 2000}
    assert (statistics.message_start_time, statistics.message_end_time) == (0, 1999)
    assert summary.channels[1].metadata['topic_type_hash'] == type_hash(FLOAT)
    assert qos.from_stored(summary.channels[1].metadata['offered_qos_profiles']) == (
        PROFILES[:1])


def test_splits_are_one_bag_again(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        number = writer.add_topic(topic())
        for part in range(3):
            writer.write((number, 100 * part + i, 0, 0, payload(100 * part + i))
                         for i in range(100))
            if part < 2:
                assert writer.split() == f'bag_{part + 1}.mcap'
    reader = BagReader(tmp_path / 'bag')
    assert [file.name for file in reader.files] == ['bag_0.mcap', 'bag_1.mcap', 'bag_2.mcap']
    assert [message.log_time for message in reader.messages()] == list(range(300))
    assert reader.counts() == {'/a': 300}
    assert not reader.problems
    with AnyReader([tmp_path / 'bag']) as other:
        assert sum(1 for _ in other.messages()) == 300
    assert [file.message_count for file in reader.metadata.files] == [100, 100, 100]


def test_messages_come_in_order_of_time_and_equal_stamps_keep_theirs(tmp_path):
    stamps = [random.Random(4).randrange(50) for _ in range(3000)]
    folder = write_bag(tmp_path / 'bag', stamps, chunk_size=2000)
    got = [(message.log_time, message.sequence) for message in BagReader(folder).messages()]
    assert got == sorted((stamp, i) for i, stamp in enumerate(stamps))


def test_a_time_span_and_topics_can_be_chosen(tmp_path):
    with BagWriter(tmp_path / 'bag', chunk_size=500) as writer:
        first, second = writer.add_topic(topic('/a')), writer.add_topic(topic('/b'))
        writer.write((number, stamp, stamp, 0, payload(stamp))
                     for stamp in range(100) for number in (first, second))
    reader = BagReader(tmp_path / 'bag')
    assert [(message.topic, message.log_time) for message in reader.messages(
        ['/b'], start=20, end=30)] == [('/b', stamp) for stamp in range(20, 30)]
    assert (reader.start_time, reader.end_time) == (0, 99)


def test_decoded_messages_have_their_fields(tmp_path):
    folder = write_bag(tmp_path / 'bag')
    decoded = list(read_messages(folder, ['/a']))
    assert [(item.topic, item.log_time_ns, item.publish_time_ns, item.message.data)
            for item in decoded] == [('/a', i, i + 5, float(i)) for i in range(10)]


def test_a_bag_of_rosbags_is_read(tmp_path):
    writer = rosbag2.Writer(
        tmp_path / 'other', version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection('/a', FLOAT, typestore=STORE)
        for i in range(100):
            writer.write(connection, i, payload(i))
    assert [item.message.data for item in read_messages(tmp_path / 'other')] == list(range(100))
    assert BagReader(tmp_path / 'other').counts() == {'/a': 100}


def test_an_existing_folder_is_refused_and_left_alone(tmp_path):
    folder = write_bag(tmp_path / 'bag')
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BadInputError, match='exists: expected the name of a new bag'):
        BagWriter(folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BadInputError, match='cannot be made'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_metadata_exist_from_the_start_and_are_read_back(tmp_path):
    writer = BagWriter(tmp_path / 'bag', custom_data={'a': 'ä'})
    start = metadata.read(tmp_path / 'bag' / 'metadata.yaml')
    assert (start.message_count, start.start_ns, start.version) == (0, metadata.NO_TIME, 9)
    writer.write([(writer.add_topic(topic(profiles=PROFILES)), 7, 8, 9, payload(1))])
    writer.close()
    end = metadata.read(tmp_path / 'bag' / 'metadata.yaml')
    assert (end.message_count, end.start_ns, end.duration_ns) == (1, 7, 0)
    assert end.custom_data == {'a': 'ä'}
    assert end.topics[0].profiles == PROFILES
    assert metadata.from_map(metadata.to_map(end), 'test') == end


def test_publishers_that_come_later_hide_nothing_from_other_readers(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        number = writer.add_topic(topic(profiles=PROFILES[:1]))
        writer.write([(number, 1, 1, 1, payload(1))])
        assert writer.add_topic(topic(profiles=PROFILES)) == number
        writer.write([(number, 2, 2, 2, payload(2))])
        writer.split()
        writer.write([(number, 3, 3, 3, payload(3))])
    with rosbag2.Reader(tmp_path / 'bag') as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == [1, 2, 3]
    assert BagReader(tmp_path / 'bag').topics['/a'].profiles == PROFILES


def test_notes_survive_without_a_clean_end(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.note({'planner.zeta': '0.1'})
    reader = BagReader(tmp_path / 'bag' / 'bag_0.mcap')
    assert reader.custom_data == {'planner.zeta': '0.1'}
    bag = BagReader(tmp_path / 'bag')
    assert bag.metadata.custom_data['planner.zeta'] == '0.1'
    assert bag.custom_data == {'planner.zeta': '0.1'}
    assert 'was not closed by its recorder' in bag.problems[-1]
    writer.close()
    assert not BagReader(tmp_path / 'bag').problems


def test_notes_that_change_for_hours_take_a_bounded_part_of_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr('hmsa.bag.writer._NOTES_SIZE', 30_000)
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic(topic())
    writer.write([(0, 1, 1, 0, bytes(1_000_000))])
    writer.flush()
    for i in range(50):
        writer.note({'lost': f'{i:01000}'})
    # A killed recorder leaves this.
    assert BagReader(tmp_path / 'bag').custom_data['lost'] == f'{49:01000}'
    writer.close()
    assert (tmp_path / 'bag' / 'bag_0.mcap').stat().st_size < 1_045_000
    alone = BagReader(tmp_path / 'bag' / 'bag_0.mcap')
    assert alone.custom_data['lost'] == f'{49:01000}'
    assert not alone.problems


def test_what_is_flushed_can_be_read_while_writing_goes_on(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    number = writer.add_topic(topic())
    writer.write([(number, 1, 1, 1, payload(1))])
    assert not list(BagReader(tmp_path / 'bag').messages())
    writer.flush()
    reader = BagReader(tmp_path / 'bag')
    assert [message.data for message in reader.messages()] == [payload(1)]
    assert not reader.complete
    writer.close()


def test_profiles_of_older_bags_are_numbers(tmp_path):
    text = """
- history: 3
  depth: 0
  reliability: 2
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
    assert qos.from_stored(text) == (
        qos.Qos(reliability='best_effort', durability='transient_local'),)
    with pytest.raises(BagError, match='expected a YAML list of profiles'):
        qos.from_stored('- history: 3')


def test_custom_data_are_pairs():
    assert parse_custom_data(['a=1', 'b=x=y', '']) == {'a': '1', 'b': 'x=y'}
    for wrong, match in ((['a'], 'expected key=value'), (['a=1', 'a=2'], 'twice')):
        with pytest.raises(BadInputError, match=match):
            parse_custom_data(wrong)


def test_a_summary_tells_counts_rates_and_losses(tmp_path):
    folder = write_bag(tmp_path / 'bag', range(0, 10**9 + 1, 10**8),
                       custom_data={'lost': '{"/a": 3}', 'sent_before': '{"/a": 1}',
                                    'plant.use_sim_time': 'true'})
    summary = summarize(folder)
    assert summary.lost == 3
    assert ('complete  yes, except 3 messages that its recorder lost and 1 message sent before '
            'the recorder was matched') in to_text(summary)
    assert summary.duration == pytest.approx(1.0)
    assert summary.topics[0].rate == pytest.approx(10.0)
    assert summary.parameters == {'plant.use_sim_time': 'true'}


def test_an_unknown_preset_is_refused(tmp_path):
    with pytest.raises(BadInputError, match='expected one of none, fastwrite, lz4'):
        BagWriter(tmp_path / 'bag', preset='fast')
    assert not Path(tmp_path / 'bag').exists()
