"""Recordings when the disk or the folder fails."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import errno
import json
import os
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys

from extras import needs
import pytest

from hmsa.bag import metadata
from hmsa.bag.output import OutputFile
from hmsa.bag.reader import BagReader
from hmsa.bag.writer import BagTopic, BagWriter, recover
from hmsa.bag.writer_thread import judge, lost_by_topic, RecordingLimits, WARN, WriterThread
from hmsa.errors import BadInputError, BagError

TOPIC = BagTopic('/a', 'std_msgs/msg/UInt8', 'uint8 data\n')
PAYLOAD = bytes((0, 1, 0, 0, 7))


def message(i, size=0):
    return (0, i, i, i, PAYLOAD + bytes(size))


def recording_in(place, reports=None, *, topic=TOPIC, **limits):
    """Return a recording of a topic in a folder or with a writer; reports are (failure, text)."""
    recording = WriterThread(
        BagWriter(place) if isinstance(place, Path) else place, RecordingLimits(**limits),
        *() if reports is None else [lambda text, failure: reports.append((failure, text))])
    recording.add_topic(topic)
    return recording


@contextmanager
def file_limit() -> Iterator[None]:
    """Limit the files of this process to 300 kB, as a quota would."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_when_a_file_may_not_grow_the_next_takes_over(tmp_path):
    reports = []
    writer = BagWriter(tmp_path / 'bag', chunk_size=20_000)
    recording = recording_in(writer, reports, flush_period=0.05)
    with file_limit():
        recording.put([message(i, 100) for i in range(10_000)], 1_000_000)
        status = recording.close()
    assert not status.error
    assert not lost_by_topic(status.overflowed, status.dropped)
    assert any(failure and 'File too large' in sentence for failure, sentence in reports)
    reader = BagReader(tmp_path / 'bag')
    assert len(reader.files) > 3
    assert [item.sequence for item in reader.messages()] == list(range(10_000))
    assert not list((tmp_path / 'bag').glob('.*'))
    assert recover(tmp_path / 'bag', tmp_path / 'recovered').message_count == 10_000


def test_a_write_that_fails_takes_room_for_the_end_again(tmp_path, monkeypatch):
    def fails(*_):
        raise OSError(5, 'Input/output error')

    file = OutputFile(tmp_path / 'a.mcap', 'none', [TOPIC])
    file.describe('', {})
    with monkeypatch.context() as patch:
        patch.setattr(os, 'write', fails)
        with pytest.raises(OSError, match='Input/output'):
            file.write([message(0)])
    assert file.path.stat().st_size == file.size
    file.write([message(1)])
    assert file.path.stat().st_size > file.size
    file.finish('', {}, fsync=False)
    assert file.path.stat().st_size == file.size
    assert file.counts == {0: 1}


def test_a_removed_folder_costs_what_was_in_it_and_that_is_counted(tmp_path, wait_until):
    reports = []
    recording = recording_in(tmp_path / 'bag', reports, flush_period=0.02)
    recording.put([message(i) for i in range(10)], 50)
    wait_until(lambda: recording.status().written == {'/a': 10}, 'the first messages')
    shutil.rmtree(tmp_path / 'bag')
    wait_until(lambda: len(reports) == 2, 'the failure and its end')
    recording.put([message(i) for i in range(10, 30)], 100)
    status = recording.close()
    assert [failure for failure, _ in reports] == [True, False]
    assert 'is gone' in reports[0][1] or 'No such file' in reports[0][1]
    assert status.dropped == {'/a': 10}
    assert status.written == {'/a': 20}
    assert [item.sequence for item in BagReader(tmp_path / 'bag').messages()] == list(
        range(10, 30))


@pytest.mark.parametrize('when', ['earlier', 'present', 'last'])
@pytest.mark.parametrize('damage', ['removed', 'shortened'])
def test_at_the_end_what_can_be_read_is_counted(tmp_path, damage, when):
    writer = BagWriter(tmp_path / 'bag', chunk_size=1000)
    # A flush of its own between the harm and the end would find the harm first.
    recording = recording_in(writer, flush_period=60.0)

    def record(first):
        recording.put([message(i) for i in range(first, first + 100)], 500)
        with suppress(OSError):  # in the file that was removed or shortened
            recording._ask(writer.flush).result()

    def harm():
        path = tmp_path / 'bag' / writer.file_name
        if damage == 'removed':
            path.unlink()
        else:
            os.truncate(path, writer._file.size // 2)

    record(0)
    if when == 'earlier':
        path = tmp_path / 'bag' / writer.file_name
        recording.split()
        if damage == 'removed':
            path.unlink()
        else:
            os.truncate(path, path.stat().st_size // 2)
    elif when == 'present':
        harm()
    record(100)
    if when == 'last':
        harm()
    status = recording.close(lambda status: {'lost': json.dumps(
        lost_by_topic(status.overflowed, status.dropped))})
    assert bool(status.error) == (when == 'last')
    if damage == 'removed' and when == 'last':
        assert status.dropped == {'/a': 200}
        return
    reader = BagReader(tmp_path / 'bag')
    count = sum(1 for _ in reader.messages())
    assert count < 200
    assert status.written == {'/a': count}
    assert status.dropped == {'/a': 200 - count}
    assert reader.custom_data == {'lost': json.dumps({'/a': 200 - count})}
    assert reader.metadata.message_count == count
    assert reader.unreadable() == 0


def test_what_does_not_fit_into_memory_is_counted_by_topic(tmp_path):
    recording = recording_in(tmp_path / 'bag', cache_size=10_000)
    recording.put([message(i) for i in range(1000)], 5000)
    recording.put([message(i) for i in range(10)], 50)
    status = recording.close()
    assert status.overflowed == {'/a': 1000}
    assert status.written == {'/a': 10}


def test_a_writer_that_cannot_write_at_the_end_says_so(tmp_path):
    recording = recording_in(tmp_path / 'bag', flush_period=60.0)
    recording.put([message(i) for i in range(10)], 50)
    shutil.rmtree(tmp_path / 'bag')
    (tmp_path / 'bag').write_text('in the way')
    status = recording.close()
    assert status.error
    assert sum(lost_by_topic(status.overflowed, status.dropped).values()) == 10


def test_a_bag_that_finds_no_room_leaves_no_folder_in_the_way_of_the_next(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(BagWriter, '_open', full)
        with pytest.raises(BadInputError, match='cannot be made .No space left'):
            BagWriter(tmp_path / 'bag')
    BagWriter(tmp_path / 'bag').close()


def test_after_the_end_nothing_more_is_done(tmp_path):
    recording = WriterThread(BagWriter(tmp_path / 'bag'), RecordingLimits())
    recording.close()
    with pytest.raises(BagError, match='the recording has ended'):
        recording.split()


@pytest.mark.parametrize(('options', 'match'), [
    ({'flush_period': 0.0}, 'expected a finite number above 0 s'),
    ({'max_size': 1023}, 'at least 1024'), ({'max_duration_ns': -1}, 'expected at least 0'),
    ({'cache_size': 0}, 'at least 1')])
def test_limits_out_of_range_are_refused(options, match):
    with pytest.raises(BadInputError, match=match):
        RecordingLimits(**options)


def test_files_are_split_by_time_span(tmp_path):
    recording = recording_in(tmp_path / 'bag', max_duration_ns=100)
    recording.put([message(i) for i in range(1000)], 5000)
    recording.close()
    stored = metadata.read(tmp_path / 'bag' / 'metadata.yaml')
    assert {file.message_count for file in stored.files[:-1]} == {101}
    assert sum(file.message_count for file in stored.files) == 1000


def test_a_snapshot_reaches_back_as_far_as_asked_for(tmp_path):
    recording = recording_in(tmp_path / 'bag', snapshot_ns=100)
    for i in range(500):
        recording.put([message(i)], 5)
    assert recording.snapshot() == '101 messages written'
    recording.close()
    assert [item.sequence for item in BagReader(tmp_path / 'bag').messages()] == list(
        range(399, 500))


def test_messages_that_a_snapshot_has_no_room_for_are_counted(tmp_path):
    recording = recording_in(tmp_path / 'bag', snapshot_ns=10**9, cache_size=3000)
    recording.put([message(0)], 5)
    recording.put([message(i) for i in range(1, 101)], 500)
    assert recording.status().queued_bytes == 0
    assert recording.close().overflowed == {'/a': 100}


# A writer that is killed: it says after each flush what is safe.
WRITER = """
import sys
from hmsa.bag.writer import BagWriter, BagTopic
writer = BagWriter(sys.argv[1], preset=sys.argv[2])
number = writer.add_topic(BagTopic('/a', 'std_msgs/msg/UInt8', 'uint8 data\\n'))
i = 0
while True:
    writer.write([(number, i + j, 0, i + j, bytes((0, 1, 0, 0, 7))) for j in range(50)])
    i += 50
    writer.flush()
    print(i, flush=True)
"""


@pytest.mark.long
def test_a_killed_writer_loses_nothing_it_has_flushed(tmp_path):
    environment = {**os.environ, 'PYTHONPATH': str(Path(__file__).resolve().parent.parent)}
    # As `python -m benchmarks crash` does with fifty recorders.
    for attempt in range(8):
        folder = tmp_path / f'bag{attempt}'
        with subprocess.Popen(
                [sys.executable, '-c', WRITER, str(folder), ('none', 'zstd_fast')[attempt % 2]],
                stdout=subprocess.PIPE, env=environment, text=True) as process:
            # A different number of flushes each time, and no more waiting: the kill hits at
            # any moment of the next ones.
            for _ in range(1 + 15 * attempt):
                safe = int(process.stdout.readline())
            process.kill()
            rest = process.stdout.read().split()
        safe = max([safe, *(int(line) for line in rest[:-1])])
        result = recover(folder, tmp_path / f'recovered{attempt}')
        assert result.message_count >= safe
        with needs('rosbags.rosbag2').Reader(tmp_path / f'recovered{attempt}') as reader:
            assert [stamp for _, stamp, _ in reader.messages()] == list(
                range(result.message_count))


def test_files_that_are_full_at_once_do_not_hold_up_the_writing(tmp_path):
    definition = 'uint8 data\n' * 2000
    recording = recording_in(
        tmp_path / 'bag', flush_period=0.05, max_size=1024,
        topic=BagTopic('/a', 'std_msgs/msg/UInt8', definition))
    recording.put([message(i) for i in range(20_000)], 100_000)
    status = recording.close()
    assert status.written == {'/a': 20_000}
    assert status.crowded > 0
    assert judge(status, 'recording', 0, flush_period=0.5)[0] == WARN
    # The burst, and what the clock has allowed since.
    assert len(BagReader(tmp_path / 'bag').files) < 60


def test_what_is_declared_is_no_part_of_the_size_of_a_file(tmp_path):
    recording = recording_in(
        tmp_path / 'bag', max_size=1024,
        topic=BagTopic('/a', 'std_msgs/msg/UInt8', 'uint8 data\n' * 2000))
    recording.put([message(i) for i in range(100)], 500)
    recording.close()
    assert [file.message_count for file in metadata.read(
        tmp_path / 'bag' / 'metadata.yaml').files] == [29, 29, 29, 13]


def test_time_that_jumps_to_and_fro_does_not_make_a_file_each_time(tmp_path):
    recording = recording_in(tmp_path / 'bag')
    for i in range(500):
        recording.put([message(i)], 5)
        recording.begin_anew()
    status = recording.close()
    assert status.crowded > 400
    assert status.written == {'/a': 500}


@pytest.mark.slow
def test_an_end_that_takes_too_long_is_cut_off_and_counted(tmp_path, monkeypatch):
    monkeypatch.setattr('hmsa.bag.writer_thread.END_SECONDS', 0.0)
    recording = recording_in(tmp_path / 'bag')
    for i in range(200_000):
        recording.put([message(i)], 5)
    status = recording.close()
    lost = sum(lost_by_topic(status.overflowed, status.dropped).values())
    assert lost > 0
    assert sum(status.written.values()) + lost == 200_000


def test_a_bag_is_not_complete_before_its_recorder_has_closed_it(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    number = writer.add_topic(TOPIC)
    writer.write([(number, 1, 1, 1, PAYLOAD)])
    writer.split()
    writer.abandon()  # as when the disk is full: no file is open, all are whole
    assert not BagReader(tmp_path / 'bag').complete
    writer.close()
    assert BagReader(tmp_path / 'bag').complete


def test_a_split_that_fails_loses_no_message(tmp_path, monkeypatch):
    writer = BagWriter(tmp_path / 'bag')
    splits = []

    def split():
        splits.append(split)
        if len(splits) == 1:
            raise OSError('no room')
        return BagWriter.split(writer)

    monkeypatch.setattr(writer, 'split', split)
    recording = recording_in(writer, max_size=1024)
    recording.put([message(i) for i in range(100)], 500)
    recording.close()
    assert len(splits) > 1
    assert [item.sequence for item in BagReader(tmp_path / 'bag').messages()] == list(range(100))
