"""Plans of many rows: by the batch if it supports them, else one by one."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmsa.errors import BadInputError, HmsaError
from hmsa.model import law
from hmsa.model.equations import Array
from hmsa.model.laws.record import Elastic
from hmsa.model.moves import Move, Setpoint, State
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import CODES, Groups, plan_two_step_batch
from hmsa_studies.residual import Actual, arrival_of
from hmsa_studies.settings import Setting

#: All codes; plans contain their indices.
STATUS = tuple(Code)
_PLACES = np.array([STATUS.index(CODES[x]) for x in sorted(CODES)])
_TWO_STEP, _LIMIT, _BAD = (
    STATUS.index(x) for x in (Code.TWO_STEP, Code.FLUX_LIMIT, Code.BAD_INPUT))


@dataclass(frozen=True)
class Plans:
    """Plans of n rows, dimensionless; NaN for missing levels or durations."""

    codes: NDArray[np.int64]  #: (n,), indices in STATUS
    numbers: Array  #: (3, n): first level, duration and last level

    @classmethod
    def none(cls, size: int) -> 'Plans':
        """Return rows that cannot be planned."""
        return cls(np.full(size, _BAD), np.full((3, size), math.nan))

    def put(
            self, rows: NDArray[np.int64] | int, codes: NDArray[np.int64] | int,
            numbers: ArrayLike) -> None:
        """Store plans at their rows."""
        self.codes[rows] = codes
        self.numbers[:, rows] = numbers


def by_batch(
        start: Array, target: Array, zeta: Array, j_lim: Array, c1: Array,
        elastic: Elastic | None = None, *, workers: int = 0) -> Plans:
    """Return two-step plans from rest on ideal hardware without limits."""
    found = plan_two_step_batch(
        start, target, Groups(zeta=zeta, j_lim=j_lim, c1=c1, elastic=elastic), workers=workers)
    return Plans(_PLACES[found.status], np.array([found.beta_p, found.tau_p, found.beta_1]))


def by_settings(
        settings: Sequence[Setting | None], which: NDArray[np.int64], start: Array,
        target: Array, shapers: NDArray[np.str_], *, workers: int = 0) -> Plans:
    """Return plans from rest; each row has the setting at `which`, None if out of range."""
    plans = Plans.none(len(which))
    # Models by index: comparing tables would take longer than planning.
    laws: dict[Elastic | None, int] = {}
    groups = np.full(len(settings), -2)
    for i, setting in enumerate(settings):
        if setting is not None:
            alone = setting.material.creep or not setting.delivery.ideal
            groups[i] = -1 if alone else laws.setdefault(setting.material.law, len(laws))
    group = np.where((groups[which] >= 0) & (shapers != 'two_step'), -1, groups[which])
    for elastic, number in laws.items():
        rows = np.flatnonzero(group == number)
        if len(rows):
            found = _limited(
                [settings[x] for x in which[rows]], start[rows], target[rows], elastic,
                workers)
            plans.put(rows, found.codes, found.numbers)
    for row in np.flatnonzero(group == -1).tolist():
        setting = settings[which[row]]
        if setting is not None:
            planned = _planned(setting, float(start[row]), float(target[row]), str(shapers[row]))
            plans.put(row, STATUS.index(planned.code), planned.numbers)
    return plans


def _limited(
        settings: Sequence[Setting | None], start: Array, target: Array,
        elastic: Elastic | None, workers: int) -> Plans:
    """Return plans of the batch, without those beyond the limits of the load."""
    given = np.array([
        (x.material.zeta, x.material.j_lim, x.material.c1, x.limits.minimum, x.limits.maximum)
        for x in settings if x is not None]).T
    zeta, j_lim, c1, least, most = given
    plans = by_batch(start, target, zeta, j_lim, c1, elastic, workers=workers)
    first, _, last = plans.numbers
    outside = (last < least) | (last > most)
    outside |= (plans.codes == _TWO_STEP) & ((first < least) | (first > most))
    plans.codes[outside] = _LIMIT
    plans.numbers[:2, outside] = math.nan
    return plans


def carried_out(
        settings: Sequence[Setting | None], actuals: Sequence[Setting | None],
        which: NDArray[np.int64], start: Array, target: Array,
        shapers: NDArray[np.str_]) -> tuple[Plans, Array, Array]:
    """Return plans, and their vibration and steady-state error on `actuals`, per step."""
    plans = Plans.none(len(which))
    # NaN without a plan or a move, or if a motion cannot be simulated.
    left = np.full((2, len(which)), math.nan)
    # Rows that differ only in the actuator share a plan.
    made: dict[tuple[Setting, float, float, str], tuple[_Planned, float]] = {}
    rows = zip(which.tolist(), start.tolist(), target.tolist(), shapers.tolist(), strict=True)
    for row, (place, begin, end, shaper) in enumerate(rows):
        setting, actual = settings[place], actuals[place]
        if setting is None:
            continue
        key = setting, begin, end, shaper
        if key not in made:
            planned = _planned(*key)
            made[key] = planned, math.nan if planned.move is None else arrival_of(
                planned.move, begin, end, setting.material)
        planned, arrival = made[key]
        plans.put(row, STATUS.index(planned.code), planned.numbers)
        if planned.move is not None and actual is not None and begin != end:
            with suppress(HmsaError):
                plant = Actual.of(setting, actual)
                left[1, row] = plant.offset(planned.move, begin, end)
                left[0, row] = plant.residual(planned.move, begin, end, arrival)
    return plans, left[0], left[1]


@dataclass(frozen=True)
class _Planned:
    """A plan of one row: its code, its command if there is one, and the holding load."""

    code: Code
    move: Move | None
    load: float

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Return first level, duration and last level."""
        move = self.move
        if move is None or (move.code is not Code.HOLD and len(move.levels) == 1):
            return math.nan, math.nan, self.load
        return move.levels[0].load, move.duration, move.levels[-1].load


def _planned(setting: Setting, start: float, target: float, shaper: str) -> _Planned:
    """Plan one row."""
    material = setting.material
    if not math.isfinite(start + target):
        return _Planned(Code.BAD_INPUT, None, math.nan)
    load = float(law.elastic_force(target, material.packed))
    try:
        move = plan_sequence(
            [Setpoint(target, math.inf)],
            MoveRequest.of(
                material, State(start), limits=setting.limits, delivery=setting.delivery,
                units=setting.units, errors=setting.errors),
            shaper)[0].move
    except RefusedError as error:
        return _Planned(error.code, None, load)
    except BadInputError:
        return _Planned(Code.OUT_OF_RANGE, None, load)
    except HmsaError:
        return _Planned(Code.NOT_CONVERGED, None, load)
    return _Planned(move.code, move, load)
