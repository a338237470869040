"""Malicious bags: nothing is executed, no access outside the bag, bounded memory."""

import json
import os
from pathlib import Path
import struct
import subprocess
import sys

import lz4.frame
from mcap.opcode import Opcode
from mcap_bytes import BEGIN, channel, chunk, END, record, schema
from mcap_bytes import metadata as metadata_record
import pytest
import yaml
import zstandard

from hmsa.bag import limits, metadata
from hmsa.bag.definitions import message_definition
from hmsa.bag.reader import BagReader, read_messages
from hmsa.bag.writer import BagTopic, BagWriter, recover
from hmsa.cli import main
from hmsa.errors import BadInputError, BagError

ROOT = Path(__file__).resolve().parent.parent
FLOAT = 'std_msgs/msg/Float64'
PAYLOAD = bytes((0, 1, 0, 0)) + bytes(8)
MEGA = 2**20
DECLARED = schema(1, FLOAT, b'float64 data\n') + channel(1, 1, '/a')

# Reads bags in every way there is, each in a process with no more memory than it is given.
READER = """
import os, resource, sys
from hmsa.bag.info import summarize, to_json, to_text
from hmsa.bag.reader import BagReader
from hmsa.bag.writer import recover
from hmsa.errors import HmsaError
import lz4.frame, mcap_ros2.decoder, zstandard

def read(path, chunk):
    reader = BagReader(path, max_chunk_size=int(chunk) * 2**20)
    count = sum(1 for _ in reader.messages())
    print(count, *reader.problems, sep='\\n')
    reader.counts()
    to_json(summarize(path)), to_text(summarize(path))
    for topic in reader.topics:
        try:
            decode = reader.decoder(topic)
            for message in reader.messages([topic]):
                decode(message.data)
        except HmsaError as error:
            print(error)

memory, *rest = sys.argv[1:]
for path, chunk in zip(rest[::2], rest[1::2]):
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_AS, (int(memory) * 2**20,) * 2)
        try:
            read(path, chunk)
        except HmsaError as error:
            print(error)
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, path
    print(end='\\0', flush=True)
"""


def read_apart(*files, memory=300):
    """Read bags, each with its largest chunk in MiB, in processes with little memory."""
    result = subprocess.run(
        [sys.executable, '-c', READER, str(memory), *(str(x) for file in files for x in file)],
        check=False, capture_output=True, text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    return result.stdout.split('\0')[:-1]


def message(data=PAYLOAD, time=1):
    return record(Opcode.MESSAGE, struct.pack('<HIQQ', 1, 0, time, time) + data)


def zstd_of_zeros(size):
    return zstandard.ZstdCompressor().compress(bytes(size))


def many_small_messages(size):
    one = message(b'')
    return one * (size // len(one))


def hostile_files():
    """Return name, content and an expected message of each file."""
    zeros = zstd_of_zeros(512 * MEGA)
    small = many_small_messages(4 * MEGA)
    overlapping = chunk(zstandard.ZstdCompressor().compress(small), len(small), end=10**9)
    large_schema = schema(2, 'x/msg/Y', b'#' * 5 * MEGA)
    packed_schema = zstandard.ZstdCompressor().compress(large_schema)
    nested = b'A[] a\n' + b'=' * 80 + b'\nMSG: x/A\n'
    many = struct.pack('<I', 10 * MEGA) + bytes(10 * MEGA)
    yield 'zstd bomb', chunk(zeros, 512 * MEGA), 'larger than the 4194304 bytes allowed'
    yield 'zstd bomb that lies', chunk(
        zeros, MEGA), 'does not decompress to the size in its header'
    yield 'lz4 bomb that lies', chunk(
        lz4.frame.compress(bytes(512 * MEGA)), MEGA, 'lz4'), (
            'bytes of content: its header states 1048576')
    yield 'declared size beyond all memory', chunk(zeros, 2**62), 'bytes allowed'
    yield 'zstd frame of unknown size', chunk(
        zstandard.ZstdCompressor(write_content_size=False).compress(bytes(64 * MEGA)),
        3 * MEGA), 'does not decompress'
    yield 'many chunks at once', overlapping * 20, 'overlap in time'
    yield 'large record', struct.pack('<BQ', Opcode.METADATA, 2**40), 'is not complete'
    yield 'large definition', large_schema, 'schema record is larger than 4194304 bytes'
    yield 'large definitions in chunks', chunk(
        packed_schema, len(large_schema)), 'larger than the 4194304 bytes allowed'
    yield 'metadata of many entries', metadata_record(
        'hmsa_ros', {str(i): '' for i in range(100_000)}) * 10, 'metadata are larger than'
    yield 'statistics that lie', record(Opcode.STATISTICS, struct.pack(
        '<QHIIIIQQI', 2**63, 1, 1, 0, 0, 1, 0, 0, 2**32 - 1)), 'statistics record ends early'
    yield 'many channels', b''.join(
        channel(i, 9, f'/{i}') for i in range(2, 2000)
        ), 'further problems are not listed'
    yield 'message of many messages', schema(
        1, 'x/msg/Y', nested) + channel(1, 1, '/a') + message(PAYLOAD[:4] + many), (
        'expected at most 8388608')
    yield 'definition within itself', schema(
        1, 'x/msg/Y', b'Y y\n') + channel(1, 1, '/a') + message(), 'does not decode'


@pytest.mark.slow
def test_sizes_that_lie_take_no_memory(tmp_path):
    files, wanted = [], []
    for name, content, expected in hostile_files():
        path = tmp_path / f'{name}.mcap'
        path.write_bytes(BEGIN + content + DECLARED + message() + END)
        files.append((path, 16 if name == 'message of many messages' else 4))
        wanted.append((name, expected))
    for (name, expected), output in zip(wanted, read_apart(*files), strict=True):
        assert expected in output, f'{name}: {output}'
        if name != 'large record':
            # What comes after it is read all the same.
            assert int(output.split('\n', 1)[0]) >= 1, f'{name}: {output}'


def test_a_file_with_holes_takes_no_memory(tmp_path):
    codes = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.SCHEMA, Opcode.METADATA)
    files = [tmp_path / f'{opcode.name}.mcap' for opcode in codes]
    for path, opcode in zip(files, codes, strict=True):
        with path.open('wb') as file:
            file.write(BEGIN + DECLARED + message() + struct.pack('<BQ', opcode, 2**36))
            file.truncate(2**36 + 2**20)
    for output in read_apart(*((path, 4) for path in files)):
        assert int(output.split('\n', 1)[0]) == 1
        assert 'skipped' in output or 'is not complete' in output


def test_a_large_chunk_is_read_when_it_is_allowed(tmp_path):
    content = message(bytes(20 * MEGA))
    path = tmp_path / 'large.mcap'
    path.write_bytes(BEGIN + DECLARED + chunk(
        zstandard.ZstdCompressor().compress(content), len(content)) + END)
    assert [len(x.data) for x in BagReader(path).messages()] == [20 * MEGA]
    reader = BagReader(path, max_chunk_size=MEGA)
    assert not list(reader.messages())
    assert 'larger than the 1048576 bytes allowed' in reader.problems[0]
    assert main(['bag', 'recover', str(path), '--out', str(tmp_path / 'a'), '--max-chunk', '1']
                ) == 0
    assert BagReader(tmp_path / 'a').counts() == {'/a': 0}
    assert main(['bag', 'recover', str(path), '--out', str(tmp_path / 'b')]) == 0
    assert BagReader(tmp_path / 'b').counts() == {'/a': 1}
    for wrong in ('0', '-1', 'nan', '1e9'):
        assert main(['bag', 'info', str(path), '--max-chunk', wrong]) == 2


def good_bag(folder):
    encoding, text = message_definition(FLOAT)
    with BagWriter(folder) as writer:
        number = writer.add_topic(BagTopic('/a', FLOAT, text, encoding))
        writer.write([(number, 1, 1, 1, PAYLOAD)])
    return folder


YAML_BOMBS = {
    'aliases': 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
        f'{b}: &{b} [{", ".join([f"*{a}"] * 9)}]\n' for a, b in zip('abcdefgh', 'bcdefghi',
                                                                   strict=True)),
    'depth': 'a: ' + '[' * 100_000,
    'number of values': 'a: [' + 'x,' * 400_000 + ']',
    'length': '#' * (limits.YAML_SIZE + 1),
    'object': 'rosbag2_bagfile_information: !!python/object/apply:os.system ["touch {there}"]',
    'date': 'rosbag2_bagfile_information: 2001-99-99',
    'integer': 'a: ' + '9' * 10_000,
    'integer tag': 'a: !!int ""',
    'infinity': 'rosbag2_bagfile_information: {version: .inf}',
    'bytes': b'\xff\xfe\x00',
}


def test_metadata_made_to_do_harm_are_left_aside(tmp_path):
    there, places = tmp_path / 'there', {}
    for name, bomb in YAML_BOMBS.items():
        places[name] = good_bag(tmp_path / name) / 'metadata.yaml'
        places[name].write_bytes(bomb if isinstance(bomb, bytes) else bomb.replace(
            '{there}', str(there)).encode())
    for name, make in {'pipe': os.mkfifo, 'endless': lambda path: path.symlink_to('/dev/zero'),
                       'loop': lambda path: path.symlink_to(path)}.items():
        places[name] = good_bag(tmp_path / name) / 'metadata.yaml'
        places[name].unlink()
        make(places[name])
    outputs = read_apart(*((path.parent, 4) for path in places.values()))
    for path in places.values():
        path.unlink()  # the bags that are left are read by others
    for name, output in zip(places, outputs, strict=True):
        assert output.startswith('1\n'), f'{name}: {output}'
        assert 'the files themselves are read' in output or name not in YAML_BOMBS, name
    assert not there.exists()


def test_files_outside_the_folder_are_not_read(tmp_path):
    bag, other = good_bag(tmp_path / 'bag'), good_bag(tmp_path / 'other')
    path = bag / 'metadata.yaml'
    content = yaml.safe_load(path.read_text())
    inner = content['rosbag2_bagfile_information']
    for outside in (str(other / 'other_0.mcap'), '../other/other_0.mcap', '..', '', '/',
                    'a\0b', '/dev/zero'):
        inner['relative_file_paths'] = [outside]
        inner['files'][0]['path'] = outside
        path.write_text(yaml.safe_dump(content))
        reader = BagReader(bag)
        assert reader.files == (bag / 'bag_0.mcap',)
    (bag / 'bag_0.mcap').unlink()
    (bag / 'bag_0.mcap').symlink_to(other / 'other_0.mcap')
    with pytest.raises(
            BadInputError, match='contains no .mcap or .db3 file: .*; name .*/bag_0.mcap'):
        BagReader(bag)
    # A link that stays inside, and one that is named itself, are what they seem.
    (other / 'other_1.mcap').symlink_to('other_0.mcap')
    assert len(BagReader(other / 'other_1.mcap').files) == 1
    assert len(BagReader(bag / 'bag_0.mcap').files) == 1


def test_one_file_named_many_times_is_read_once(tmp_path):
    bag = good_bag(tmp_path / 'bag')
    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    content['rosbag2_bagfile_information']['files'] *= 1000
    (bag / 'metadata.yaml').write_text(yaml.dump(content, Dumper=NoAliases))
    assert len(list(BagReader(bag).messages())) == 1


class NoAliases(yaml.CSafeDumper):
    def ignore_aliases(self, data):
        return True


def test_profiles_made_to_do_harm_are_left_aside(tmp_path):
    files = []
    for name, bomb in YAML_BOMBS.items():
        text = bomb.decode('latin-1') if isinstance(bomb, bytes) else bomb
        files.append(tmp_path / f'{name}.mcap')
        files[-1].write_bytes(BEGIN + schema(1, FLOAT, b'float64 data\n') + channel(
            1, 1, '/a', {'offered_qos_profiles': text[:2 * MEGA]})
            + message() + END)
    for output in read_apart(*((path, 4) for path in files)):
        assert output.startswith('1\n')


def test_what_would_take_over_a_terminal_is_shown_as_codes(tmp_path, capsys):
    path = tmp_path / 'bag.mcap'
    data = channel(1, 1, '/a\x1b[2Jb').replace(b'[2Jb', b'[2J\xff')
    path.write_bytes(BEGIN + schema(
        1, FLOAT, b'float64 data\n') + data + message() + metadata_record(
        'hmsa_ros', {'note\x07': 'two\nlines \x9b31m'}) + END)
    assert main(['bag', 'info', str(path)]) == 0
    shown = capsys.readouterr().out
    assert '/a\\x1b[2J\\xff' in shown
    assert 'note\\x07 = two\\nlines \\x9b31m' in shown
    assert main(['bag', 'info', '--json', str(path)]) == 0
    assert json.loads(capsys.readouterr().out)['topics'][0]['count'] == 1
    with pytest.raises(BadInputError):
        BagReader(path).decoder('/none\x1b')
    assert main(['bag', 'verify', str(path)]) == 2
    assert '\x1b' not in capsys.readouterr().err
    assert recover(path, tmp_path / 'new').message_count == 1
    assert list(read_messages(tmp_path / 'new'))


def test_requests_of_a_foreign_definition_are_passed_over(tmp_path, capsys):
    path = tmp_path / 'bag.mcap'
    path.write_bytes(BEGIN + schema(
        1, 'trajectory_msgs/msg/JointTrajectory', b'float64 data\n') + channel(
        1, 1, '/planner/joint_trajectory') + message() + END)
    assert main(['bag', 'info', str(path)]) == 0
    assert '/planner/joint_trajectory' in capsys.readouterr().out


def test_a_type_name_imports_nothing_but_interfaces():
    from hmsa_ros.nodes.ros_entities import interface_class
    assert interface_class(FLOAT).__name__ == 'Float64'
    for name in ('antigravity/msg/A', 'os/path/join', 'this/msg/A', '../x/msg/A', 'std_msgs',
                 'std_msgs/os/A', 'std_msgs/msg/', 'std_msgs/msg/../A', '\0/msg/A'):
        with pytest.raises(BagError, match='is not installed'):
            interface_class(name)
    assert not {'antigravity', 'this'} & sys.modules.keys()


def test_problems_are_told_but_not_without_end(tmp_path):
    bag = good_bag(tmp_path / 'bag')
    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    content['rosbag2_bagfile_information']['files'] = [
        {**content['rosbag2_bagfile_information']['files'][0], 'path': f'x{i}.mcap'}
        for i in range(2000)]
    (bag / 'metadata.yaml').write_text(yaml.dump(content, Dumper=NoAliases))
    reader = BagReader(bag)
    assert len(reader.problems) == limits.PROBLEMS + 1
    assert metadata.read(bag / 'metadata.yaml').message_count == 1
