"""Contents of diagnostics, in particular the planner's verdict."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
import json
import math
import re
from typing import Any

from hmsa.errors import printable
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
