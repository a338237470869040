"""Summarize a bag."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
import datetime
import json
import os

from hmsa.bag import limits, qos
from hmsa.bag.metadata import node_parameters, parameter_key
from hmsa.bag.reader import BagReader
from hmsa.errors import BagError, listed, printable

# Keys of the JSON output, in this order.
_SHOWN = (
    'path', 'files', 'start_ns', 'end_ns', 'duration', 'message_count', 'lost', 'sent_before',
    'unreadable', 'topics', 'parameters', 'custom_data', 'closed', 'complete', 'problems')
# Keys of custom data with counts by topic.
_COUNTED = 'lost', 'sent_before'


@dataclass(frozen=True)
class TopicSummary:
    """The summary of one topic."""

    name: str
    type: str
    count: int
    rate: float | None  #: messages per second over the length of the bag; None if undefined
    lost: int | None  #: None if the recorder did not count
    sent_before: int | None  #: sent before the recorder was matched; None if not counted
    reliability: str  #: of the publishers, separated by slashes; empty if unknown
    durability: str


@dataclass(frozen=True)
class BagSummary:
    """The summary of a bag."""

    path: str  #: as given
    files: tuple[tuple[str, int], ...]  #: name and size in bytes
    start_ns: int | None  #: first log time; None without a message
    end_ns: int | None
    topics: tuple[TopicSummary, ...]  #: in order of name
    parameters: Mapping[str, str]  #: of the recorded nodes, values as JSON
    custom_data: Mapping[str, str]  #: all other custom data
    unreadable: int  #: messages that the bag lists and that cannot be read
    closed: bool  #: whether every file was closed by its writer
    complete: bool  #: whether it was closed, and every message that it lists can be read
    problems: tuple[str, ...]  #: parts that could not be read, one sentence each

    @property
    def duration(self) -> float:
        """Return the length in seconds."""
        if self.start_ns is None or self.end_ns is None:
            return 0.0
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def message_count(self) -> int:
        """Return the number of messages."""
        return sum(topic.count for topic in self.topics)

    @property
    def lost(self) -> int | None:
        """Return the number of lost messages, None if the recorder did not count."""
        return self._sum('lost')

    def missing(self, topics: Collection[str] | None = None) -> str:
        """
        Return which messages are missing, as a part of a sentence; empty if none is known to be.

        Of those that the recorder lost, only ``topics`` count, by default all.
        """
        parts = []
        if self.unreadable:
            total = self.message_count + self.unreadable
            parts.append(f'{self.unreadable} of {total} messages cannot be read')
        if not self.closed:
            parts.append('the last messages may be missing: the bag was cut off, or its recorder '
                         'was killed or is still recording')
        elif not (self.complete or self.unreadable):
            parts.append('a part of it is damaged')
        lost = [f'{x.lost} of {x.name}' for x in self.topics
                if x.lost and (topics is None or x.name in topics)]
        if lost:
            parts.append(f'its recorder lost {listed(lost)}')
        return '; '.join(parts)

    @property
    def sent_before(self) -> int | None:
        """Return how many messages were sent before the recorder was matched; None if unknown."""
        return self._sum('sent_before')

    def _sum(self, name: str) -> int | None:
        counted = [x for topic in self.topics if (x := getattr(topic, name)) is not None]
        return sum(counted) if counted else None


def summarize(bag: str | os.PathLike[str] | BagReader) -> BagSummary:
    """Return the summary of a bag or of its reader; raise `BadInputError` if it is no bag."""
    reader = bag if isinstance(bag, BagReader) else BagReader(bag)
    # This comes first because it detects damage.
    counts, unreadable = reader.counts(), reader.unreadable()
    start, end = reader.start_time, reader.end_time
    seconds = 0.0 if start is None or end is None else (end - start) * 1e-9
    lost, before = (missing_messages(reader.custom_data, key) for key in _COUNTED)
    topics = tuple(TopicSummary(
        name, topic.type, counts[name],
        (counts[name] - 1) / seconds if seconds > 0.0 and counts[name] > 1 else None,
        None if lost is None else lost.get(name, 0),
        None if before is None else before.get(name, 0),
        '/'.join(sorted({x.reliability for x in topic.profiles})),
        '/'.join(sorted({x.durability for x in topic.profiles})))
        for name, topic in sorted(reader.topics.items()))
    parameters = {
        parameter_key(node, name): value
        for node, values in node_parameters(reader.custom_data).items()
        for name, value in values.items()}
    return BagSummary(
        str(reader.path), tuple((file.name, file.stat().st_size) for file in reader.files), start,
        end, topics, parameters,
        {key: value for key, value in reader.custom_data.items()
         if key not in {*parameters, *_COUNTED} and not key.startswith(qos.LATER)},
        unreadable, reader.closed, reader.complete and not unreadable, tuple(reader.problems))


def missing_messages(custom_data: Mapping[str, str], key: str) -> dict[str, int] | None:
    """
    Return the counts by topic in a bag's custom data; None if missing.

    The key is ``lost``, or ``sent_before`` for messages sent before the recorder was matched.
    """
    try:
        counts = limits.load_json(custom_data[key])
    except (KeyError, BagError):
        return None
    good = isinstance(counts, dict) and all(
        isinstance(count, int) and 0 <= count < 2**63 for count in counts.values())
    return counts if good else None


def to_json(summary: BagSummary, notes: Sequence[str] = ()) -> str:
    """Return a summary and notes as one JSON object."""
    shown = asdict(summary) | {
        'files': [{'name': name, 'size': size} for name, size in summary.files]}
    return json.dumps(
        {key: shown.get(key, getattr(summary, key)) for key in _SHOWN} | {'notes': list(notes)},
        indent=2, allow_nan=False)


def to_text(
        summary: BagSummary, notes: Sequence[str] = (), *, parameters: bool = False) -> str:
    """Return a summary and notes as text, optionally with the parameters."""
    return '\n'.join(map(printable, _lines(summary, notes, parameters)))


def _lines(
        summary: BagSummary, notes: Iterable[str], parameters: bool) -> Iterator[str]:
    """Return the lines of a summary."""
    yield f'bag       {summary.path}'
    for name, size in summary.files:
        yield f'file      {name}  {size / 1024:.1f} KiB'
    without = [f'{_messages(count)} {what}' for count, what in (
        (summary.lost, 'that its recorder lost'),
        (summary.sent_before, 'sent before the recorder was matched')) if count]
    yield 'complete  ' + (
        f'yes{", except " if without else ""}{" and ".join(without)}' if summary.complete
        else f'no: {summary.missing(())}; see hmsa bag recover')
    if summary.start_ns is not None:
        yield f'start     {_time(summary.start_ns)}'
    yield f'duration  {summary.duration:.3f} s'
    yield f'messages  {summary.message_count}'
    yield 'lost      ' + ('unknown' if summary.lost is None else str(summary.lost))
    if summary.topics:
        rows = [('topic', 'type', 'count', 'rate [1/s]', 'lost', 'offered')]
        rows += [(
            topic.name, topic.type or 'unknown', str(topic.count),
            '' if topic.rate is None else f'{topic.rate:.1f}',
            '' if topic.lost is None else str(topic.lost),
            ', '.join(filter(None, (topic.reliability, topic.durability))))
            for topic in summary.topics]
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        yield ''
        for row in rows:
            yield '  '.join(f'{text:{side}{width}}' for text, side, width in zip(
                row, '<<>>><', wide, strict=True)).rstrip()
    if summary.parameters and not parameters:
        nodes = ', '.join(dict.fromkeys(x.partition('.')[0] for x in summary.parameters))
        yield ''
        yield f'{len(summary.parameters)} parameters of {nodes}: --parameters shows them'
    for title, values in (
            ('parameters', summary.parameters if parameters else {}),
            ('custom data', summary.custom_data)):
        if values:
            yield ''
            yield title
            for key, value in values.items():
                yield f'  {key} = {value if len(value) <= 200 else value[:200] + " ..."}'
    for topic in summary.topics:
        if topic.sent_before:
            yield (f'note: {_messages(topic.sent_before)} of {topic.name} sent before the '
                   'recorder was matched')
    if silent := [x.name for x in summary.topics if not x.count]:
        yield f'note: no message was received on {", ".join(silent)}'
    yield from (f'note: {x}' for x in (*summary.problems, *notes))


def _messages(count: int) -> str:
    return f'{count} message{"s" * (count != 1)}'


def _time(nanoseconds: int) -> str:
    """Return a time as a date, or in seconds if simulated."""
    seconds = nanoseconds * 1e-9
    if seconds < 1e8:
        return f'{seconds:.9f} s'
    return datetime.datetime.fromtimestamp(seconds).astimezone().isoformat(sep=' ')
