"""
Contents of diagnostics: the planner's verdict, and the outcome of each requested setpoint.

An outcome is what was asked, planned and found. The planner publishes one for each setpoint as
soon as it is decided, and a newer one if that changes; reports and comparisons read them.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
import json
import math
import re
from typing import Any

from hmsa.errors import printable
from hmsa.judge.records import Finding, RequestedSetpoint
from hmsa.model.status import Code

# A status may come from any publisher; Python refuses to parse integers of thousands of digits.
_WHOLE = re.compile('[0-9]{1,18}')
_WARN = 1
# Warnings of a plan that ends as requested.
_HARMLESS = (Code.TOO_DAMPED, Code.INDISTINGUISHABLE)


def texts(status: Any) -> dict[str, str]:
    """Return the values of a diagnostic_msgs/msg/DiagnosticStatus by key, both printable."""
    return {printable(x.key): printable(x.value) for x in status.values}


def whole(text: str | None) -> int:
    """Return a whole number from a status, 0 if there is none."""
    return int(text) if text and _WHOLE.fullmatch(text) else 0


def real(text: str | None) -> float:
    """Return a number from a status, NaN if there is none."""
    try:
        return float(text or '')
    except ValueError:
        return math.nan


def _object(text: str) -> Mapping[str, object]:
    """Return a JSON object, or an empty mapping if a text is not one."""
    with suppress(ValueError, RecursionError):
        found = json.loads(text)
        if isinstance(found, dict):
            return found
    return {}


@dataclass(frozen=True)
class StatusVerdict:
    """
    The planner's verdict on its last request.

    ``level`` is 0 OK, 1 WARN or 2 ERROR, ``code`` is one of `Code`. ``request`` is the name given
    by the sender. ``state`` is idle, waiting, moving, holding, settling or at_rest, during the
    move to ``setpoint``, counted from 1. While ``watching``, started setpoints are still to be
    judged by samples. ``measured`` is the code of the worst finding, ``finding`` its message and
    ``figures`` its values. ``measuring`` indicates recent samples, and ``late`` is the number of
    late commands since the planner started. ``unheard`` is the reason why commands are not carried
    out. ``plan`` is the number of plans until then, and ``answers`` contains the verdicts on
    recent requests by name. ``newest`` contains the code of the newest finding and its setpoint by
    joint, whose name is empty if there is only one.
    """

    level: int
    message: str
    code: str
    request: str
    state: str
    setpoint: int
    setpoints: int
    watching: bool = False
    measured: str = ''
    finding: str = ''
    unheard: str = ''
    measuring: bool = False
    late: int = 0
    figures: Mapping[str, object] = field(default_factory=dict)
    plan: int = 0
    answers: Mapping[str, object] = field(default_factory=dict)
    newest: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def of_last(self, joints: Sequence[str]) -> 'StatusVerdict':
        """Return the verdict with the finding of the last setpoint of joints, not the worst."""
        if self.figures.get('setpoint') == self.setpoints:
            return self
        found = [x for name, x in self.newest.items() if not name or name in joints]
        code, number = next((x for x in found if x[0] != Code.ARRIVED), (*found, ('', 0))[0])
        return replace(
            self, measured=code, finding=f'setpoint {number} of {self.setpoints}: {code}',
            figures={})

    def on(self, request: str) -> 'StatusVerdict | None':
        """Return the verdict on a recent request by its name, None if it is not known."""
        if self.request == request:
            return self
        match self.answers.get(request):
            case [int(level), str(code), str(message), int(plan)]:
                return replace(
                    self, level=level, code=printable(code), message=printable(message),
                    request=request, plan=plan)
        return None

    @property
    def failure(self) -> str:
        """Why a completed request counts as failed; empty if it does not."""
        if self.level > _WARN:
            return self.message
        if self.measured == Code.ARRIVED:
            return ''
        if self.measured and (self.measured != Code.UNOBSERVED or self.measuring):
            return self.finding
        # Without samples, a prediction counts as long as the plan is followed.
        if self.level == _WARN and self.code not in _HARMLESS:
            return f'{self.message}; the result is not measured'
        return ''

    @property
    def basis(self) -> str:
        """Whether the result is measured or predicted, or its failure, in words."""
        if self.measured == Code.ARRIVED:
            return 'measured'
        return self.failure or 'predicted, not measured'

    @classmethod
    def read(cls, status: Any) -> 'StatusVerdict':
        """Read a DiagnosticStatus published by the planner."""
        values = texts(status)
        return cls(
            status.level[0], printable(status.message), values.get('code', ''),
            values.get('request', ''), values.get('state', ''),
            whole(values.get('setpoint')), whole(values.get('setpoints')),
            values.get('watching') == 'True', values.get('worst', ''),
            values.get('worst_message', ''), values.get('unheard', ''),
            values.get('measuring') == 'True', whole(values.get('late')),
            _object(values.get('finding', '')), whole(values.get('plan')),
            _object(values.get('answers', '')),
            {x.removesuffix('measured').rstrip('.'): (y, whole(values.get(f'{x}_setpoint')))
             for x, y in values.items() if x == 'measured' or x.endswith('.measured')})


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
