"""Bags of SQLite, of ROS 1, and compressed as a whole."""

import json
import sqlite3
import struct
import subprocess
import sys

from extras import needs
import numpy as np
import pytest

from hmsa.bag.info import summarize
from hmsa.bag.reader import BagReader, read_messages
from hmsa.bag.writer import BagTopic, BagWriter
from hmsa.cli import main
from hmsa.errors import BadInputError

rosbag1, rosbag2 = needs('rosbags.rosbag1'), needs('rosbags.rosbag2')
typesys = needs('rosbags.typesys')
STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
NOETIC = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
KIND = 'sensor_msgs/msg/JointState'
STAMPS = [10**9 + i * 10**6 for i in range(50)]


def state(store, stamp, **of_ros1):
    types = store.types
    time = types['builtin_interfaces/msg/Time'](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return types[KIND](
        header=types['std_msgs/msg/Header'](stamp=time, frame_id='', **of_ros1), name=['one'],
        position=np.array([stamp * 1e-9]), velocity=np.zeros(1), effort=np.zeros(1))


def write(folder, plugin='SQLITE3', compression='NONE'):
    writer = rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression != 'NONE':
        writer.set_compression(
            rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/joint_states', KIND, typestore=STORE)
        for stamp in STAMPS:
            writer.write(connection, stamp, STORE.serialize_cdr(state(STORE, stamp), KIND))
    return folder


def check(path):
    """Check that a bag is read completely."""
    reader = BagReader(path)
    assert [x.log_time for x in reader.messages()] == STAMPS
    assert (reader.counts(), reader.problems) == ({'/joint_states': len(STAMPS)}, [])
    assert reader.complete
    assert not reader.unreadable()
    assert (reader.start_time, reader.end_time) == (STAMPS[0], STAMPS[-1])
    assert [(x.message.header.stamp.nanosec, x.message.position[0]) for x in read_messages(
        path, ['/joint_states'], start=STAMPS[3], end=STAMPS[5])] == [
        (stamp % 10**9, stamp * 1e-9) for stamp in STAMPS[3:5]]


@pytest.mark.parametrize(('plugin', 'compression'), [
    ('SQLITE3', 'NONE'), ('SQLITE3', 'FILE'), ('SQLITE3', 'MESSAGE'), ('MCAP', 'FILE'),
    ('MCAP', 'MESSAGE')])
def test_sqlite_and_compressed_bags_are_read_and_made_mcap(tmp_path, plugin, compression):
    folder = write(tmp_path / 'bag', plugin, compression)
    check(folder)
    (name, size), = summarize(folder).files
    assert size == (folder / name).stat().st_size
    assert main(['bag', 'recover', str(folder), '--out', str(tmp_path / 'new')]) == 0
    check(tmp_path / 'new')
    assert (tmp_path / 'new' / 'new_0.mcap').is_file()


def without_definitions(path):
    """Make a database one of before Iron, which stores no definitions."""
    with sqlite3.connect(path) as database:
        database.execute('DROP TABLE message_definitions')
        database.execute('UPDATE schema SET schema_version = 3')
    database.close()


def test_a_database_without_definitions_uses_those_of_its_distribution(tmp_path, monkeypatch):
    folder = write(tmp_path / 'bag')
    without_definitions(folder / 'bag.db3')
    monkeypatch.setattr('hmsa.bag.definitions.share_folders', list)
    check(folder)
    check(folder / 'bag.db3')
    (folder / 'metadata.yaml').unlink()
    assert len(list(BagReader(folder).messages())) == len(STAMPS)


def test_a_bag_of_ros1_is_read_and_not_rewritten(tmp_path, capsys, refusal):
    path = tmp_path / 'run.bag'
    with rosbag1.Writer(path) as writer:
        connection = writer.add_connection('/joint_states', KIND, typestore=NOETIC)
        for stamp in STAMPS:
            writer.write(
                connection, stamp, NOETIC.serialize_ros1(state(NOETIC, stamp, seq=0), KIND))
    check(path)
    assert main(['bag', 'info', str(path), '--json']) == 0
    topic, = json.loads(capsys.readouterr().out)['topics']
    assert (topic['type'], topic['count']) == (KIND, len(STAMPS))
    assert f'convert it with "rosbags-convert --src {path}' in refusal(
        'bag recover', path, '--out', tmp_path / 'new')
    with pytest.raises(BadInputError, match=r'such as .*run\.bag'):
        BagReader(tmp_path)


def test_a_damaged_database_is_read_up_to_the_damage(tmp_path, capsys, refusal):
    writer = rosbag2.Writer(tmp_path / 'bag', version=8)
    with writer:
        connection = writer.add_connection('/a', 'std_msgs/msg/String', typestore=STORE)
        for i in range(10):
            # So large that most of it lies beyond the page that is counted.
            writer.write(connection, i, bytes((0, 1, 0, 0)) + bytes((i + 1,)) * 20_000)
    path = tmp_path / 'bag' / 'bag.db3'
    intact = path.read_bytes()
    page = intact.index(bytes((6,)) * 4000) // 4096 * 4096 + 4096
    path.write_bytes(intact[:page] + bytes(4096) + intact[page + 4096:])
    assert main(['bag', 'info', str(path.parent)]) == 1
    assert 'no: 5 of 10 messages cannot be read' in capsys.readouterr().out
    assert main(['bag', 'recover', str(path.parent), '--out', str(tmp_path / 'new')]) == 0
    assert 'malformed: the rest is skipped' in capsys.readouterr().err
    assert [x.log_time for x in BagReader(tmp_path / 'new').messages()] == list(range(5))
    path.write_bytes(intact[:len(intact) // 2])
    assert 'malformed' in refusal('bag info', path.parent)


def test_what_a_killed_recorder_left_beside_a_database_is_said(tmp_path, capsys):
    folder = write(tmp_path / 'bag')
    (folder / 'bag.db3-wal').write_bytes(b'messages')
    assert main(['bag', 'info', str(folder)]) == 1
    assert 'the messages in bag.db3-wal are not read' in capsys.readouterr().out


def test_links_in_a_compressed_bag_are_not_followed(tmp_path):
    folder = write(tmp_path / 'bag', compression='FILE')
    path = folder / 'bag.db3.zstd'
    path.rename(tmp_path / 'elsewhere')
    path.symlink_to(tmp_path / 'elsewhere')
    with pytest.raises(BadInputError, match='contains the link bag.db3.zstd'):
        BagReader(folder)


IDL = """================================================================================
IDL: made/msg/Pair
module made { module msg { struct Pair { made::msg::Number first; double second; }; }; };
================================================================================
IDL: made/msg/Number
module made { module msg { struct Number { double data; }; }; };
"""


def test_a_type_defined_in_idl_is_decoded(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        number = writer.add_topic(BagTopic('/a', 'made/msg/Pair', IDL, 'ros2idl'))
        writer.write([(number, 1, 1, 1, bytes((0, 1, 0, 0)) + struct.pack('<dd', 1.5, 2.5))])
    read, = read_messages(tmp_path / 'bag')
    assert (read.message.first.data, read.message.second) == (1.5, 2.5)


def test_an_mcap_bag_is_read_without_rosbags(tmp_path):
    folder = write(tmp_path / 'bag', 'MCAP')
    subprocess.run([sys.executable, '-c', (
        'import sys; sys.modules["rosbags"] = None; from hmsa.bag.reader import read_messages; '
        f'assert len(list(read_messages({str(folder)!r}))) == {len(STAMPS)}')], check=True)
