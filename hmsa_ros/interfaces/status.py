"""What diagnostics say, and the planner's verdict among them."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
import json
import math
import re
from typing import Any

from hmsa_ros.errors import printable
from hmsa_ros.model.status import Code

# Anybody may send a status; Python refuses to read numbers of thousands of digits.
_WHOLE = re.compile('[0-9]{1,18}')
_WARN = 1
# Warnings of a plan that ends as requested.
_HARMLESS = (Code.TOO_DAMPED, Code.INDISTINGUISHABLE)


def texts(status: Any) -> dict[str, str]:
    """Return the values of a diagnostic_msgs/msg/DiagnosticStatus by key, both printable."""
    return {printable(x.key): printable(x.value) for x in status.values}


def whole(text: str | None) -> int:
    """Return the whole number in a status, 0 where it has none."""
    return int(text) if text and _WHOLE.fullmatch(text) else 0


def real(text: str | None) -> float:
    """Return the number in a status, NaN where it has none."""
    try:
        return float(text or '')
    except ValueError:
        return math.nan


def _object(text: str) -> Mapping[str, object]:
    """Return a JSON object, empty where a text is none."""
    with suppress(ValueError, RecursionError):
        found = json.loads(text)
        if isinstance(found, dict):
            return found
    return {}


@dataclass(frozen=True)
class Verdict:
    """
    What the planner says of its last request, named as it was sent.

    The level is 0 OK, 1 WARN or 2 ERROR, the code one of `Code`. ``state`` is idle, waiting,
    moving, holding, settling or at_rest, on the way to ``setpoint``, from 1. While ``watching``,
    setpoints that have begun are still to be judged by samples; the worst that was ``measured``
    is a code, with its sentence ``finding`` and its ``figures``. Samples have come lately while
    ``measuring``, and so many commands were ``late`` since the planner began. ``unheard`` says
    why nobody carries out commands.
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

    @property
    def failure(self) -> str:
        """Why a request that has come to its end counts as failed; empty if it does not."""
        if self.level > _WARN:
            return self.message
        if self.measured == Code.ARRIVED:
            return ''
        if self.measured and (self.measured != Code.UNOBSERVED or self.measuring):
            return self.finding
        # Nobody measures: a prediction counts as long as it is kept to.
        if self.level == _WARN and self.code not in _HARMLESS:
            return f'{self.message}; what comes of it is not measured'
        return ''

    @property
    def basis(self) -> str:
        """What the state is known from, in words."""
        if self.measured == Code.ARRIVED:
            return 'measured'
        return self.failure or 'predicted, not measured'

    @classmethod
    def read(cls, status: Any) -> 'Verdict':
        """Read a DiagnosticStatus that the planner publishes."""
        values = texts(status)
        return cls(
            status.level[0], printable(status.message), values.get('code', ''),
            values.get('request', ''), values.get('state', ''),
            whole(values.get('setpoint')), whole(values.get('setpoints')),
            values.get('watching') == 'True', values.get('worst', ''),
            values.get('worst_message', ''), values.get('unheard', ''),
            values.get('measuring') == 'True', whole(values.get('late')),
            _object(values.get('finding', '')))
