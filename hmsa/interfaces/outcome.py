"""
The outcome of a requested setpoint: what was asked, planned and found.

The planner publishes one for each setpoint as soon as it is decided, and a newer one if that
changes; reports and comparisons read them.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
import json
import math
from typing import Any

from hmsa.errors import printable
from hmsa.interfaces.status import texts
from hmsa.judge.records import Finding, RequestedSetpoint
from hmsa.model.status import Code

#: What a request asks for: setpoints to rest at, the end of a path, or the rest after raw levels.
SETPOINT, PATH, LEVELS = 'setpoint', 'path', 'levels'
#: Ends of a setpoint before its time, besides the codes of plans that are dropped.
REPLACED, STOPPED = 'replaced', 'stopped'
# Figures of a finding, in stretch; missing if undetermined.
_FIGURES = ('offset', 'offset_std', 'vibration', 'vibration_std', 'frequency', 'noise')
# Times beyond belong to no clock; they come from other publishers.
_LATEST = 2**62
# Slowest vibration in rad/s; slower ones would make a window of years.
_SLOWEST = 1e-6


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f'{text} in an outcome: expected a finite number')
    return value


def _time(value: str | int) -> int:
    time = int(value)
    if abs(time) > _LATEST:
        raise ValueError(f'{time} ns in an outcome: expected a time of a clock')
    return time


def _count(text: str) -> int:
    count = int(text)
    if not 0 <= count < 2**31:
        raise ValueError(f'{count} in an outcome: expected a number of setpoints')
    return count


def _flag(text: str) -> bool:
    return text == str(True)


# Fields of an outcome in a status, under their names, and what reads them; times are in ns.
_OWN: dict[str, Callable[[str], Any]] = {
    'asked': str, 'request': str, 'plan': _count, 'through': _count, 'coordinate': str,
    'corrected': _flag, 'ended': str, 'until': _time, 'decided': _time}
# Fields of its setpoint by key, and what reads them.
_ASKED: dict[str, tuple[str, Callable[[str], Any]]] = {
    'setpoint': ('number', _count), 'setpoints': ('count', _count), 'target': ('target', _finite),
    'start': ('start', _finite), 'begins': ('begins', _time), 'end': ('end', _time),
    'held': ('held', _flag), 'omega': ('frequency', _finite),
    'decay': ('decay', lambda x: max(_finite(x), 0.0)), 'joint': ('joint', str)}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one requested setpoint; times in ns."""

    #: As requested; `moved` is the arrival of the newest plan, if it is another.
    setpoint: RequestedSetpoint
    asked: str = SETPOINT  #: one of `SETPOINT`, `PATH` and `LEVELS`
    request: str = ''  #: name of the request, if any
    plan: int = 0  #: number of the accepted request, from 1
    joint: str = ''  #: its name, also if it is the only one
    coordinate: str = 'stretch'  #: in which the setpoint is given
    decided: int = 0  #: time of the decision
    #: Number of the last setpoint that this concerns: those that never began share an outcome.
    through: int = 0
    #: Begin and arrival of its move, as planned first and after each new plan; an arrival is None
    #: if the target is only approached. The commands in between belong to the setpoint.
    moves: tuple[tuple[int, int | None], ...] = ()
    corrected: bool = False  #: whether it was planned anew from samples, and not in need
    #: Why it ended before its time: `REPLACED`, `STOPPED`, or the code of the status; else empty.
    ended: str = ''
    until: int | None = None  #: when it ended before its time
    #: Judged from samples; None if it ended before it could be.
    finding: Finding | None = None

    @property
    def missed(self) -> bool:
        """Whether it was not carried out."""
        return self.finding is not None and self.finding.verdict is Code.MISSED

    @property
    def arrival(self) -> int | None:
        """Planned rest at the target by the newest plan; None if only approached."""
        return self.setpoint.newest_arrival

    @property
    def key(self) -> tuple[str, int, int, int]:
        """Joint, plan, number and begin: the same for all outcomes of one setpoint."""
        return self.joint, self.plan, self.setpoint.number, self.setpoint.begins

    @property
    def message(self) -> str:
        """A sentence: the finding, or why there is none."""
        if self.finding is not None:
            return self.finding.message
        which = self.setpoint.where if self.through <= self.setpoint.number else (
            f'{self.setpoint.where.partition(" of ")[0]} to {self.through} of '
            f'{self.setpoint.count}')
        return f'{which}: {self.ended.replace("_", " ") or "over"} before arrival'

    def to_texts(self) -> dict[str, str]:
        """Return the outcome as the values of a status, by key; unknown values are omitted."""
        asked = self.setpoint
        values: dict[str, object] = {
            **{x: getattr(self, x) for x in _OWN},
            'through': max(self.through, asked.number), 'moves': json.dumps(self.moves),
            'arrival': self.arrival, 'lowest': asked.possible[0], 'highest': asked.possible[1],
            **{x: getattr(asked, name) for x, (name, _) in _ASKED.items()}}
        if self.finding is not None:
            values |= {'verdict': str(self.finding.verdict), 'samples': self.finding.samples}
            values |= {x: y for x in _FIGURES
                       if math.isfinite(y := getattr(self.finding, x))}
        return {key: str(x) for key, x in values.items() if x is not None}

    @classmethod
    def read(cls, status: Any) -> 'Outcome':
        """
        Read a DiagnosticStatus of the planner.

        Raises
        ------
        ValueError
            If it is no outcome, or a value is none that a planner publishes.

        """
        values = texts(status)
        try:
            return cls._of(values, printable(status.message), printable(status.hardware_id))
        except (KeyError, TypeError, OverflowError, RecursionError) as error:
            raise ValueError(f'an outcome has no usable value: {error}') from error

    @classmethod
    def _of(cls, values: Mapping[str, str], message: str, joint: str) -> 'Outcome':
        moves = tuple(
            (_time(begin), None if arrival is None else _time(arrival))
            for begin, arrival in json.loads(values['moves']))
        first = moves[0][1] if moves else None
        last = moves[-1][1] if moves else None
        asked: dict[str, Any] = {
            name: read(values[x]) for x, (name, read) in _ASKED.items() if x in values}
        setpoint = RequestedSetpoint(
            **asked, arrival=first, moved=None if last == first else last,
            possible=(float(values.get('lowest', '-inf')), float(values.get('highest', 'inf'))))
        if not setpoint.frequency >= _SLOWEST:
            raise ValueError(f'omega is {setpoint.frequency:g}: expected at least {_SLOWEST:g}')
        found = None
        if verdict := values.get('verdict'):
            found = Finding(
                Code(verdict), message, setpoint, _count(values.get('samples', '0')),
                **{x: float(values.get(x, 'nan')) for x in _FIGURES})
        own: dict[str, Any] = {x: read(values[x]) for x, read in _OWN.items() if x in values}
        return cls(**own, setpoint=setpoint, joint=joint, moves=moves, finding=found)


def newest(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return the last outcome of each setpoint, by begin."""
    found = {x.key: x for x in outcomes}
    return sorted(found.values(), key=lambda x: (x.setpoint.begins, x.plan, x.setpoint.number))
