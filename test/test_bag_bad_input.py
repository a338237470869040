"""Damaged, foreign and old bags: clear messages, no traceback, and all readable data."""

import contextlib
import json
import os
from pathlib import Path
import random
import shutil
import struct

from extras import needs
from hypothesis import given, HealthCheck, settings, strategies
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from mcap_bytes import chunk, pieces, record
import pytest
import yaml
import zstandard

from hmsa.bag import metadata, qos
from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.info import summarize, to_json, to_text
from hmsa.bag.reader import BagReader, read_messages
from hmsa.bag.records import MAGIC, MessageBlock, PREFIX
from hmsa.bag.writer import BagTopic, BagWriter, recover
from hmsa.cli import main
from hmsa.errors import BadInputError, BagError

FLOAT = 'std_msgs/msg/Float64'


def payload(value):
    return bytes((0, 1, 0, 0)) + struct.pack('<d', value)


def write_bag(folder, count=400, preset='none'):
    encoding, text = message_definition(FLOAT)
    with BagWriter(folder, preset=preset, chunk_size=1000) as writer:
        number = writer.add_topic(BagTopic(
            '/a', FLOAT, text, encoding, (qos.Qos(),), type_hash(FLOAT)))
        writer.write((number, i, i, i, payload(i)) for i in range(count))
    return folder / f'{folder.name}_0.mcap'


def write_with_mcap(path, count=400, **options):
    """Write a file as other programs do."""
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=1000, **options)
        writer.start('ros2', 'test')
        encoding, text = message_definition(FLOAT)
        schema = writer.register_schema(FLOAT, encoding, text.encode())
        channel = writer.register_channel('/a', 'cdr', schema, {})
        for i in range(count):
            writer.add_message(channel, i, payload(i), i)
        writer.finish()
    return path


def write_raw(path, encoding='cdr', stamp=1):
    """Write a file of one message without a schema, as other programs do."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        channel = writer.register_channel('/a', encoding, 0, {})
        writer.add_message(channel, stamp, payload(1), stamp)
        writer.finish()
    return path


def flip_a_bit(path):
    """Flip a bit in the second chunk of a file."""
    data = bytearray(path.read_bytes())
    chunks = [offset for opcode, offset, _ in pieces(bytes(data)) if opcode == Opcode.CHUNK]
    data[chunks[1] + 100] ^= 0x10
    path.write_bytes(data)


def stamps(path):
    """Read a file, and return reader and log times; only the package's errors may occur."""
    reader = BagReader(path)
    return reader, [message.log_time for message in reader.messages()]


@pytest.mark.parametrize('preset', ['none', 'zstd_fast', 'lz4'])
def test_a_file_cut_anywhere_is_read_up_to_the_cut(tmp_path, preset):
    data = write_bag(tmp_path / 'bag', preset=preset).read_bytes()
    cut = tmp_path / 'cut.mcap'
    before = 0
    # Hundreds of cuts over the three presets, the ends among them.
    lengths = sorted({*random.Random(3).sample(range(len(data)), 120), *range(10),
                      *range(len(data) - 10, len(data))})
    for length in lengths:
        cut.write_bytes(data[:length])
        if length < len(MAGIC):
            with pytest.raises(BadInputError, match='is empty|was cut off'):
                BagReader(cut)
            continue
        reader, got = stamps(cut)
        assert got == list(range(len(got)))
        assert len(got) >= before
        before = len(got)
        assert not reader.complete
        assert any('is not complete' in problem for problem in reader.problems)
    assert before == 400


def test_a_cut_bag_is_recovered_for_every_reader(tmp_path):
    path = write_bag(tmp_path / 'bag')
    data = path.read_bytes()
    for i, length in enumerate((60, len(data) // 2, len(data) - 1)):
        path.write_bytes(data[:length])
        result = recover(tmp_path / 'bag', tmp_path / f'recovered{i}')
        with needs('rosbags.rosbag2').Reader(tmp_path / f'recovered{i}') as reader:
            assert [stamp for _, stamp, _ in reader.messages()] == list(
                range(result.message_count))
        assert result.problems
    assert result.message_count == 400


@pytest.mark.parametrize('preset', ['none', 'zstd_fast', 'lz4'])
def test_a_flipped_byte_in_a_chunk_costs_that_chunk(tmp_path, preset):
    path = write_bag(tmp_path / 'bag', preset=preset)
    _, intact = stamps(path)
    flip_a_bit(path)
    reader, got = stamps(path)
    assert 0 < len(got) < len(intact)
    assert set(got) < set(intact)
    problem, = reader.problems
    assert 'chunk' in problem
    assert 'skipped' in problem
    assert reader.counts() == {'/a': len(got)}


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(strategies.data())
def test_no_change_of_bytes_makes_the_reader_fail(tmp_path, data):
    path = tmp_path / 'bag' / 'bag_0.mcap'
    if not path.exists():
        write_bag(tmp_path / 'bag', 100, preset='zstd_fast')
    original = path.read_bytes()
    changed = bytearray(original)
    for _ in range(data.draw(strategies.integers(1, 4))):
        position = data.draw(strategies.integers(0, len(changed) - 1))
        changed[position] = data.draw(strategies.integers(0, 255))
    end = data.draw(strategies.integers(0, len(changed)) | strategies.just(len(changed)))
    copy = tmp_path / 'changed.mcap'
    copy.write_bytes(changed[:end])
    # Only the package's own errors, and only for what cannot be read at all.
    with contextlib.suppress(BagError, BadInputError):
        reader, got = stamps(copy)
        reader.counts()
        assert len(got) <= 100
        list(read_messages(copy))


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(content=strategies.binary(max_size=300))
def test_no_bytes_after_the_magic_make_the_reader_fail(tmp_path, content):
    path = tmp_path / 'any.mcap'
    path.write_bytes(MAGIC + content)
    reader, _ = stamps(path)
    reader.counts()


def changed_value(draw, value):
    """Return a value with some parts replaced."""
    if draw(strategies.integers(0, 15)) == 0:
        return draw(ODD_VALUES)
    if isinstance(value, dict):
        return {key: changed_value(draw, item) for key, item in value.items()
                if draw(strategies.integers(0, 30))}
    if isinstance(value, list):
        return [changed_value(draw, item) for item in value] * draw(strategies.integers(0, 2))
    return value


ODD_VALUES = strategies.one_of(
    strategies.none(), strategies.booleans(), strategies.integers(), strategies.floats(),
    strategies.text(max_size=10), strategies.binary(max_size=5), strategies.just([]),
    strategies.just({}), strategies.just(['..', '/', '']))


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(strategies.data())
def test_no_change_of_the_metadata_hides_the_messages(tmp_path, data):
    folder = tmp_path / 'bag'
    if not folder.exists():
        write_bag(folder, 10)
        shutil.copy(folder / 'metadata.yaml', tmp_path / 'original.yaml')
    content = yaml.safe_load((tmp_path / 'original.yaml').read_text())
    changed = changed_value(data.draw, content)
    (folder / 'metadata.yaml').write_text(yaml.safe_dump(changed, allow_unicode=True))
    try:
        _read_whole(folder)
    finally:
        # The bag that is left is read by others.
        shutil.copy(tmp_path / 'original.yaml', folder / 'metadata.yaml')


def _read_whole(folder):
    with contextlib.suppress(BagError):
        stored = metadata.read(folder / 'metadata.yaml')
        if stored.storage != 'mcap' or stored.compression_mode.upper() not in ('', 'NONE'):
            # Only a bag that says to be of another kind is refused.
            with pytest.raises(BadInputError, match='is stored as|is compressed by rosbag2'):
                BagReader(folder)
            return
    _, got = stamps(folder)
    assert got == list(range(10))
    to_json(summarize(folder))
    assert to_text(summarize(folder)).encode()


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(strategies.data())
def test_no_records_in_any_order_make_the_reader_fail(tmp_path, data):
    path = tmp_path / 'bag' / 'bag_0.mcap'
    if not path.exists():
        write_bag(tmp_path / 'bag', 60, preset='none')
    original = [(opcode, content) for opcode, _, content in pieces(path.read_bytes())]
    chosen = data.draw(strategies.lists(
        strategies.integers(0, len(original) - 1), min_size=1, max_size=len(original)))
    content = MAGIC
    for i in chosen:
        opcode, piece = original[i]
        if opcode == Opcode.CHUNK and data.draw(strategies.booleans()):
            # Compressed anew, so that what is wrong in it is found by nothing but reading.
            stored = MessageBlock.of_chunk(0, -PREFIX.size, piece, len(piece))
            inner = bytearray(piece[stored.offset:])
            for _ in range(data.draw(strategies.integers(0, 3))):
                inner[data.draw(strategies.integers(0, len(inner) - 1))] = data.draw(
                    strategies.integers(0, 255))
            content += chunk(
                zstandard.ZstdCompressor().compress(bytes(inner)), len(inner), 'zstd',
                data.draw(strategies.integers(0, 100)), data.draw(strategies.integers(0, 100)))
        else:
            content += record(opcode, piece)
    copy = tmp_path / 'changed.mcap'
    copy.write_bytes(content + data.draw(strategies.sampled_from((b'', MAGIC))))
    reader, got = stamps(copy)
    assert len(got) == sum(reader.counts().values()) or reader.complete
    list(reader.stored_messages())
    to_text(summarize(copy))
    with contextlib.suppress(BagError):
        list(read_messages(copy))


@pytest.mark.parametrize('options', [
    {'use_chunking': False}, {'compression': CompressionType.LZ4},
    {'compression': CompressionType.ZSTD}, {'repeat_channels': False, 'repeat_schemas': False},
    {'use_statistics': False, 'use_summary_offsets': False}, {'enable_crcs': False}])
def test_what_other_writers_make_is_read(tmp_path, options):
    path = write_with_mcap(tmp_path / 'other.mcap', **options)
    reader, got = stamps(path)
    assert got == list(range(400))
    assert reader.counts() == {'/a': 400}
    assert not reader.problems
    assert [item.message.data for item in read_messages(path)] == list(range(400))


def test_damage_outside_the_chunks_is_got_around_by_the_index(tmp_path):
    path = write_bag(tmp_path / 'bag')
    data = bytearray(path.read_bytes())
    indexes = [offset for opcode, offset, _ in pieces(bytes(data))
               if opcode == Opcode.MESSAGE_INDEX]
    # Nothing after a record whose length is wrong can be found record by record.
    struct.pack_into('<Q', data, indexes[2] + 1, 2**40)
    path.write_bytes(data)
    reader, got = stamps(path)
    assert got == list(range(400))
    # It costs nothing, since the index names the chunks; the CRC of the data shows it.
    assert reader.counts() == {'/a': 400}
    assert any('the CRC of its data differs' in problem for problem in reader.problems)


def test_a_file_that_is_no_mcap_is_named(tmp_path, capsys):
    for content, expected in (
            (b'', 'is empty: expected an MCAP file'),
            (b'{"a": 1}', 'is not an MCAP file, as it begins with'),
            (MAGIC[:4], 'was cut off after 4 bytes')):
        path = tmp_path / 'file.mcap'
        path.write_bytes(content)
        assert main(['bag', 'info', str(path)]) == 2
        error = capsys.readouterr().err
        assert error.startswith('hmsa: error: ')
        assert expected in error
        assert error.count('\n') == 1
    table = tmp_path / 'camera.csv'
    table.write_text('time,stretch\n0,1\n')
    with pytest.raises(BadInputError, match='is a table: expected a bag; hmsa identify'):
        BagReader(table)


def test_what_is_not_there_is_said(tmp_path, refusal):
    (tmp_path / 'empty').mkdir()
    for name, expected in (
            ('none', 'does not exist'), ('/proc/self/mem', 'cannot be read (Input/output error)'),
            ('empty', 'contains no .mcap or .db3 file')):
        assert expected in refusal('bag info', tmp_path / name)


@pytest.mark.parametrize('in_folder', [True, False])
@pytest.mark.parametrize(('name', 'content', 'advice'), [
    ('a.db3', b'', 'or database missing tables.): expected a bag of MCAP, SQLite or ROS 1'),
    ('a.db3', b'SQLite format 3\0 ...', 'a.db3 cannot be read ('),
    ('a.mcap.zstd', zstandard.compress(MAGIC), 'decompress it with "zstd -d FILE"'),
    ('a.bag', b'#ROSBAG V2.0\n', 'a.bag'),
    *((f'a{x}', b'version https://git-lfs.github.com/spec/v1\n', 'the file with "git lfs pull"')
      for x in ('.mcap', '.db3', '.bag'))])
def test_a_file_that_is_no_bag_is_refused_with_a_way_on(
        tmp_path, refusal, name, content, advice, in_folder):
    (tmp_path / 'bag').mkdir()
    path = tmp_path / 'bag' / name
    path.write_bytes(content)
    assert advice in refusal('bag info', path.parent if in_folder else path)


def test_a_bag_that_rosbag2_has_indexed_again_is_read(tmp_path):
    write_bag(tmp_path / 'bag')
    path = tmp_path / 'bag' / 'metadata.yaml'
    path.write_text(path.read_text().replace('storage_identifier: mcap', "storage_identifier: ''"))
    reader = BagReader(tmp_path / 'bag')
    assert reader.metadata.storage == ''
    assert len(list(reader.messages())) == 400
    assert not reader.problems


def test_empty_definitions_are_those_of_the_installed_types(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        for i, (kind, hash_of) in enumerate((
                (FLOAT, type_hash(FLOAT)), (FLOAT, 'RIHS01_' + '0' * 64), ('x/msg/Y', ''))):
            number = writer.add_topic(BagTopic(f'/t{i}', kind, '', 'ros2msg', (), hash_of))
            writer.write([(number, i, i, i, payload(i))])
    reader = BagReader(tmp_path / 'bag')
    read, = read_messages(tmp_path / 'bag', ['/t0'])
    assert read.message.data == 0.0
    assert reader.topics['/t0'].definition == message_definition(FLOAT)[1]
    for i, reason in ((1, 'is not the recorded one, as their hashes differ'),
                      (2, 'no definition of message type x/msg/Y')):
        assert any(f'/t{i} has no message definition' in x and reason in x
                   for x in reader.problems)
        with pytest.raises(BagError, match='no message definition'):
            reader.decoder(f'/t{i}')


def test_a_missing_or_wrong_metadata_file_does_not_hide_the_messages(tmp_path):
    write_bag(tmp_path / 'bag')
    path = tmp_path / 'bag' / 'metadata.yaml'
    text = path.read_text()
    for content, expected in (
            (None, 'is missing: the files themselves are read'),
            ('a: [', 'is not YAML'),
            ('a: 1', 'has no key rosbag2_bagfile_information'),
            (text.replace('version: 9', 'version: 99'), 'is of version 99'),
            (text.replace('message_count', 'count'), 'cannot be understood')):
        if content is None:
            path.unlink()
        else:
            path.write_text(content)
        reader, got = stamps(tmp_path / 'bag')
        assert got == list(range(400))
        assert any(expected in problem for problem in reader.problems)


@pytest.mark.parametrize('version', range(1, 9))
def test_older_metadata_are_read(tmp_path, version):
    write_bag(tmp_path / 'bag')
    path = tmp_path / 'bag' / 'metadata.yaml'
    content = yaml.safe_load(path.read_text())
    inner = content['rosbag2_bagfile_information']
    inner['version'] = version
    for since, key in ((8, 'ros_distro'), (6, 'custom_data'), (5, 'files'),
                       (3, 'compression_format'), (3, 'compression_mode')):
        if version < since:
            del inner[key]
    for topic in inner['topics_with_message_count']:
        entry = topic['topic_metadata']
        entry['offered_qos_profiles'] = yaml.safe_dump(entry['offered_qos_profiles'])
        if version < 7:
            del entry['type_description_hash']
        if version < 4:
            del entry['offered_qos_profiles']
    if version < 4:
        inner['relative_file_paths'] = [f'bag/{name}' for name in inner['relative_file_paths']]
    path.write_text(yaml.safe_dump(content))
    reader, got = stamps(tmp_path / 'bag')
    assert not reader.problems
    assert got == list(range(400))
    assert reader.metadata.version == version


def test_two_bags_under_one_name_are_told_apart(tmp_path):
    write_bag(tmp_path / 'bag')
    other = write_bag(tmp_path / 'other')
    shutil.copy(other, tmp_path / 'bag')
    reader, got = stamps(tmp_path / 'bag')
    assert len(got) == 400
    assert any('also contains other_0.mcap' in problem for problem in reader.problems)
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    with pytest.raises(BadInputError, match=r'several bags \(bag, other\)'):
        BagReader(tmp_path / 'bag')


def test_a_file_named_in_the_metadata_that_is_missing_is_told(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        number = writer.add_topic(BagTopic('/a', FLOAT))
        writer.write([(number, 1, 1, 1, payload(1))])
        writer.split()
        writer.write([(number, 2, 2, 2, payload(2))])
    (tmp_path / 'bag' / 'bag_0.mcap').unlink()
    reader, got = stamps(tmp_path / 'bag')
    assert got == [2]
    assert any('bag_0.mcap is missing' in problem for problem in reader.problems)


def test_a_bag_of_no_messages_is_a_bag(tmp_path, capsys):
    BagWriter(tmp_path / 'bag').close()
    reader, got = stamps(tmp_path / 'bag')
    assert (got, reader.start_time, reader.problems) == ([], None, [])
    assert main(['bag', 'info', str(tmp_path / 'bag')]) == 0
    assert 'messages  0' in capsys.readouterr().out


def test_messages_that_never_saw_a_clock_are_read(tmp_path):
    reader, got = stamps(write_raw(tmp_path / 'zero.mcap', stamp=0))
    assert got == [0]
    assert (reader.start_time, reader.end_time, reader.counts()) == (0, 0, {'/a': 1})


@pytest.mark.parametrize('encoding', ['cdr', 'json'])
def test_a_missing_schema_leaves_the_messages_raw(tmp_path, encoding):
    path = write_raw(tmp_path / 'raw.mcap', encoding)
    reader, got = stamps(path)
    assert got == [1]
    recover(path, tmp_path / 'whole')
    # What is sent again or decoded goes by it.
    assert BagReader(tmp_path / 'whole').topics['/a'].encoding == encoding
    assert any('has no message definition' in problem for problem in reader.problems)
    with pytest.raises(BagError, match='cannot be decoded'):
        list(read_messages(path, ['/a']))
    assert not list(read_messages(path))


@pytest.mark.parametrize(('topic', 'data', 'said'), [
    (BagTopic('/a', 'x/msg/Y', 'nonsense ::: here\n'), payload(1),
     'definition of x/msg/Y in the bag cannot be read'),
    (BagTopic('/a', FLOAT, *reversed(message_definition(FLOAT))), bytes((0, 1, 0, 0, 1)),
     'does not decode as std_msgs/msg/Float64')])
def test_a_definition_or_payload_that_cannot_be_read_is_named(tmp_path, topic, data, said):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write([(writer.add_topic(topic), 1, 1, 1, data)])
    with pytest.raises(BagError, match=said):
        list(read_messages(tmp_path / 'bag', ['/a']))


def test_a_topic_that_is_not_there_is_named(tmp_path):
    write_bag(tmp_path / 'bag')
    with pytest.raises(BadInputError, match='has no topic /b: expected one of /a'):
        BagReader(tmp_path / 'bag').decoder('/b')


def test_a_definition_that_is_not_installed_is_named():
    with pytest.raises(BagError, match='no definition of message type no_such/msg/Type found'):
        message_definition('no_such/msg/Type')
    with pytest.raises(BagError, match='expected a name such as'):
        message_definition('wrong')
    assert type_hash('no_such/msg/Type') == ''


def test_info_and_recover_tell_of_damage_without_failing(tmp_path, capsys, refusal):
    path = write_bag(tmp_path / 'bag')
    path.write_bytes(path.read_bytes()[:-200])
    assert main(['bag', 'info', str(tmp_path / 'bag')]) == 0
    assert 'is not complete' in capsys.readouterr().out
    assert main(['bag', 'recover', str(tmp_path / 'bag'), '--out', str(tmp_path / 'new')]) == 0
    assert '400 messages recovered' in capsys.readouterr().out
    assert 'exists' in refusal('bag recover', tmp_path / 'bag', '--out', tmp_path / 'new')


def test_profiles_out_of_range_are_refused():
    with pytest.raises(BagError, match='expected one of'):
        qos.Qos(reliability='sure')
    with pytest.raises(BagError, match='expected at least 0'):
        qos.Qos(depth=-1)


def test_metadata_that_cannot_be_opened_are_named(tmp_path):
    with pytest.raises(BagError, match='is no file'):
        metadata.read(tmp_path)


def test_a_message_lost_from_a_chunk_is_said_by_recover(tmp_path, capsys):
    flip_a_bit(write_bag(tmp_path / 'bag'))
    assert main(['bag', 'recover', str(tmp_path / 'bag'), '--out', str(tmp_path / 'new')]) == 0
    assert 'of 400 messages cannot be read' in capsys.readouterr().err
    assert main(['bag', 'info', str(tmp_path / 'bag')]) == 1
    shown = capsys.readouterr().out
    assert 'complete  no: 24 of 400 messages cannot be read; see hmsa bag recover' in shown
    assert 'the CRC of its data differs' in shown
    assert main(['bag', 'info', str(tmp_path / 'bag'), '--json']) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found['complete'], found['closed'], found['unreadable']) == (False, True, 24)


def test_a_recovery_that_is_cancelled_leaves_no_bag_that_says_it_is_whole(tmp_path, monkeypatch):
    write_bag(tmp_path / 'bag')
    monkeypatch.setattr(BagReader, 'stored_messages', interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover(tmp_path / 'bag', tmp_path / 'new')
    reader = BagReader(tmp_path / 'new')
    assert not reader.complete
    assert 'was not closed by its recorder' in ' '.join(reader.problems)


def interrupted(self):
    yield next(self.messages())
    raise KeyboardInterrupt


@pytest.mark.parametrize('lost', [
    '{"/a": 1e999}', '{"/a": NaN}', '{"/a": ' + '9' * 4300 + '}', '[' * 200_000, '{"/a": -1}',
    '[1]', '{"/a": "1"}'])
def test_counts_of_losses_that_make_no_sense_are_left_aside(tmp_path, lost):
    with BagWriter(tmp_path / 'bag', custom_data={'lost': lost}) as writer:
        writer.add_topic(BagTopic('/a', FLOAT))
    summary = summarize(tmp_path / 'bag')
    assert summary.lost is None
    json.loads(to_json(summary), parse_constant=pytest.fail)


def test_a_folder_whose_name_is_no_text_is_written_and_read(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path / 'bag') + b'\xff'))
    write_bag(tmp_path / 'bag')
    assert main(['bag', 'recover', str(tmp_path / 'bag'), '--out', str(folder)]) == 0
    assert BagReader(folder).counts() == {'/a': 400}
    assert main(['bag', 'info', str(folder)]) == 0


def test_metadata_that_are_a_link_out_of_the_folder_are_not_followed(tmp_path):
    write_bag(tmp_path / 'bag')
    path = tmp_path / 'bag' / 'metadata.yaml'
    path.rename(tmp_path / 'elsewhere.yaml')
    path.symlink_to(tmp_path / 'elsewhere.yaml')
    reader = BagReader(tmp_path / 'bag')
    assert reader.metadata is None
    assert any('is a link' in problem for problem in reader.problems)
    assert reader.counts() == {'/a': 400}
