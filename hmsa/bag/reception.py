"""Process received messages and the state of a recorder, without ROS."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
import time
from typing import Any

from hmsa.bag.output import Entry
from hmsa.bag.qos import Qos
from hmsa.bag.writer_thread import Status

OK, WARN, ERROR = range(3)
# Messages always wait for a flush: longer delays, in flush periods and in s, are reported.
_BEHIND_PERIODS = 4.0
_BEHIND_SECONDS = 1.0


@dataclass
class RecordedTopic:
    """A recorded topic: its subscription and its publishers."""

    name: str
    type: str
    number: int  #: of the topic in the bag
    qos: Any  #: with which it is subscribed to
    offered: tuple[Qos, ...]  #: by its publishers
    publishers: int = 0  #: at the last look
    last: dict[bytes, int] = field(default_factory=dict)  #: sequence number by publisher
    latest: dict[bytes, int] = field(default_factory=dict)  #: reception in ns by publisher
    received: int = 0
    largest: int = 0  #: payload so far, in bytes
    missed: int = 0  #: gaps in the sequence numbers
    before: int = 0  #: sent by publishers before they were matched

    @property
    def latched(self) -> bool:
        """Return whether a publisher may send its last messages to late subscribers."""
        return any(x.durability == 'transient_local' for x in self.offered)

    def begin_anew(self) -> None:
        """Accept reception timestamps before the latest ones: the clock was set back."""
        self.latest.clear()

    def take(
            self, messages: Iterable[tuple[int, int, int, bytes, bytes]],
            at: Callable[[int], int] | None, *, paused: bool) -> tuple[list[Entry], int]:
        """Count gaps; return the messages to write, and the length of their payloads in bytes."""
        # A message has source and reception timestamp in ns, sequence number, publisher, payload.
        # at() converts system time to log time. Messages during a pause do not count as missed.
        batch: list[Entry] = []
        size, largest = 0, self.largest
        for source, received, sequence, publisher, data in messages:
            before = self.last.get(publisher)
            largest = max(largest, len(data))
            if before is not None and sequence <= before:
                continue  # already received by the previous subscription
            if before is not None and not paused:
                self.missed += sequence - before - 1
            elif not paused and not self.latched:
                # Volatile publishers count from 1, and send nothing to late subscribers.
                self.before += sequence - 1
            self.last[publisher] = sequence
            if paused:
                continue
            # Not every middleware provides reception timestamps. A message that had to be sent
            # again is received after its successors, which are delivered only then.
            stamp = max(received or time.time_ns(), self.latest.get(publisher, 0))
            self.latest[publisher] = stamp
            batch.append((self.number, stamp if at is None else at(stamp), source, sequence, data))
            size += len(data)
        self.received += len(batch)
        self.largest = largest
        return batch, size


def judge(
        status: Status, state: str, lost: int, *, flush_period: float, clocks: int = 0,
        clock_ignored: bool = False) -> tuple[int, str]:
    """Return the level and the sentence of a recorder's diagnostics; ``flush_period`` in s."""
    if status.error:
        return ERROR, status.error
    reasons = []
    if lost:
        reasons.append(f'{lost} messages lost')
    if status.behind > max(_BEHIND_SECONDS, _BEHIND_PERIODS * flush_period):
        reasons.append(f'writing is {status.behind:.1f} s behind')
    if status.crowded:
        reasons.append('the limits ask for more than one file per second: files become longer '
                       'than configured')
    text = ', '.join([state, *reasons])
    if clock_ignored or clocks > 1:
        return WARN, f'{text}; {clocks} publishers of /clock, the first one is followed'
    return (WARN if reasons else OK), text


def figures(
        status: Status, lost: Mapping[str, int], before: Mapping[str, int]) -> dict[str, str]:
    """Return the values of a recorder's diagnostics, by key; ``behind`` is in seconds."""
    return {
        'file': status.file,
        'written': str(sum(status.written.values())),
        'lost': str(sum(lost.values())),
        'sent_before': str(sum(before.values())),
        'queued_bytes': str(status.queued_bytes),
        'behind': f'{status.behind:.3f}',
        'files_refused': str(status.crowded),
        **{f'lost.{name}': str(count) for name, count in lost.items() if count},
        **{f'sent_before.{name}': str(count) for name, count in before.items() if count}}
