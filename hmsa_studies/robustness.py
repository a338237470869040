"""
Robustness: residuals of each shaper's moves on an actuator that differs from the model.

Each shaper plans with the nominal parameters. The plan is carried out by an actuator with errors
in shear modulus G, damping coefficient and J_lim, each alone and all together anywhere in a box.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
import math
from pathlib import Path
from typing import Any

import numpy as np

from hmsa.errors import BadInputError, check_number, HmsaError
from hmsa.files import write_rows
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.equations import (
    Array,
    critical_zeta,
    elastic_force,
    equilibrium_stretch,
    Floats,
    natural_frequency,
)
from hmsa.model.moves import Level, Limits, Move, State
from hmsa.model.parameters import Errors, NondimensionalParameters
from hmsa.model.simulation import residual_vibration, sampled
from hmsa.model.status import Code, RefusedError
from hmsa.motion import STRETCH
from hmsa.planning.shapers import get_shaper, SHAPERS
from hmsa.planning.shapers.creeping import held
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import plan_two_step
from hmsa_studies.axes import Setting
from hmsa_studies.study_folder import RowStudy

# The peak-to-peak value of a decaying motion is final after one period, or after its decay.
_PERIODS = 2.0
_DECADES = 12.0
# 150 samples per period miss 2e-4 of an extremum.
_SAMPLES = 301
_EXACT = Errors()


def arrival_of(
        move: Move, start: float, target: float, material: NondimensionalParameters) -> float:
    """Return the time (of the model) from which motion counts as residual vibration."""
    # The end of the command. For an unshaped step, which never arrives, use the arrival of the
    # two-step command; if there is none, half a natural period.
    if math.isfinite(move.duration):
        return move.duration
    if not material.creep:
        plan = plan_two_step(start, target, material)
        if plan.code is Code.TWO_STEP:
            return plan.tau_p
    return math.pi / float(natural_frequency(target, material))


def ringing(stretch: float, material: NondimensionalParameters) -> tuple[float, float]:
    """Return the period (infinite if there is none) and decay of small motion about rest."""
    frequency = float(natural_frequency(stretch, material))
    ratio = material.zeta / float(critical_zeta(stretch, material))
    if ratio < 1.0:
        return 2.0 * math.pi / (frequency * math.sqrt(1.0 - ratio * ratio)), frequency * ratio
    return math.inf, frequency * (ratio - math.sqrt(ratio * ratio - 1.0))


@dataclass(frozen=True)
class Actual:
    """An actuator that carries out moves planned with another model, in the model's units."""

    model: NondimensionalParameters
    material: NondimensionalParameters  #: of the actuator, in its own units
    time: float = 1.0  #: the actuator's units relative to those of the model
    load: float = 1.0
    delivery: Delivery = IDEAL  #: in the actuator's units; commands are those of the move

    @classmethod
    def off(
            cls, model: NondimensionalParameters, errors: Errors = _EXACT,
            delivery: Delivery = IDEAL) -> 'Actual':
        """Return the actuator for errors of a model, with the same coil."""
        return cls(
            model, errors.actual(model), 1.0 / errors.faster, errors.stiffer,
            errors.delivery(delivery))

    @classmethod
    def of(cls, model: Setting, actual: Setting) -> 'Actual':
        """Return an actuator with its own parameters."""
        return cls(
            model.material, actual.material, actual.units.time / model.units.time,
            actual.units.load / model.units.load, actual.delivery)

    def response(self, move: Move, start: float, times: Floats) -> Array:
        """Sample the stretch from the true equilibrium under the model's initial load."""
        held = float(elastic_force(start, self.model)) / self.load
        stretch: Array = sampled(
            [Level(x.time / self.time, x.load / self.load) for x in move.levels],
            State(float(equilibrium_stretch(held, self.material)), load=held),
            np.asarray(times / self.time, dtype=np.float64), self.material,
            self.delivery)[STRETCH]
        return stretch

    def rest(self, move: Move) -> float:
        """Return the true equilibrium stretch under the last level of a move."""
        return float(equilibrium_stretch(move.levels[-1].load / self.load, self.material))

    def residual(self, move: Move, start: float, target: float, arrival: float) -> float:
        """Return the peak-to-peak stretch after arrival as a fraction of the commanded step."""
        # A steady-state error, due to an error of the holding load, is no vibration and does not
        # count.
        period, decay = ringing(self.rest(move), self.material)
        horizon = min(_PERIODS * period, _DECADES / decay if decay > 0.0 else math.inf)
        times = arrival + np.linspace(0.0, horizon * self.time, _SAMPLES)
        return residual_vibration(
            times, self.response(move, start, times), arrival=arrival, end=float(times[-1]),
            step=target - start)

    def offset(self, move: Move, start: float, target: float) -> float:
        """Return the steady-state error of a move beyond the target, as a fraction of the step."""
        return (self.rest(move) - target) / (target - start)


#: Parameters with errors: display name, and name in `Errors`.
PARAMETERS = {'G': 'shear_modulus', 'zeta': 'zeta', 'J_lim': 'j_lim'}
#: Orders to compare of shapers that have one.
ORDERS = (2, 3)
ORDERED = ('robust', 'minimax')
#: Maximum order, far beyond useful ones.
MOST_ORDER = 100
#: Number of values of a parameter in the curves, besides the edges of the box.
_POINTS = 41
# Number of values of a parameter in the box, including edges and centre.
_BOX_POINTS = 9
#: Maximum error.
LARGEST = 0.9

_NAMES = {
    'two_step': 'two-step', 'minimum_time': 'minimum time', 'step': 'unshaped step', 'zv': 'ZV',
    'zvd': 'ZVD', 'ei': 'EI', 'umzv': 'UM-ZV'}
_LINEAR = ('zv', 'zvd', 'ei', 'umzv')


@dataclass(frozen=True)
class Candidate:
    """A shaper to compare."""

    shaper: str
    order: int = 2  #: for shapers in ORDERED

    def __post_init__(self) -> None:
        """Check shaper and order."""
        get_shaper(self.shaper)
        check_number(f'order of the shaper {self.shaper}', self.order, least=1, most=MOST_ORDER)

    @property
    def name(self) -> str:
        """Display name."""
        if self.shaper in ORDERED:
            return f'{self.shaper}, order {self.order}'
        return _NAMES.get(self.shaper, self.shaper)

    @property
    def linear(self) -> bool:
        """Whether it is a linear shaper, as a reference."""
        return self.shaper in _LINEAR

    @property
    def label(self) -> str:
        """Name with the design point of a reference."""
        return f'{self.name} (linear, designed at the target)' if self.linear else self.name


@dataclass(frozen=True)
class Case:
    """A move between stretches at rest, its model, and errors; in the model's units."""

    start: float
    target: float
    material: NondimensionalParameters = field(default_factory=NondimensionalParameters)
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = IDEAL
    box: float = 0.1  #: half the width of the box of errors, above 0
    span: float = 0.2  #: maximum error in the curves, at least that of the box

    def __post_init__(self) -> None:
        """Check the values."""
        self.material.check(self.start, 'start stretch')
        self.material.check(self.target, 'target stretch')
        if abs(self.target - self.start) < 1e-6:
            raise BadInputError(
                f'the move from {self.material.coordinate.name} {self.start:g} to '
                f'{self.target:g} is none: expected two {self.material.coordinate.plural} that '
                'differ')
        if not 0.0 < self.box <= self.span <= LARGEST:
            raise BadInputError(
                f'errors of up to {self.box:g} in the box and {self.span:g} in the curves: '
                f'expected numbers above 0 to {LARGEST:g}, the first not the larger one')

    @property
    def name(self) -> str:
        """Display name."""
        return f'{self.start:g} to {self.target:g}, {self.nominal}'

    @property
    def parameters(self) -> dict[str, str]:
        """Those of `PARAMETERS` that the model has."""
        limited = self.material.law is None and math.isfinite(self.material.j_lim)
        return {x: y for x, y in PARAMETERS.items() if y != 'j_lim' or limited}

    @property
    def nominal(self) -> str:
        """One-line description of the model."""
        material = self.material
        whose = f'J_lim {material.j_lim:g}' if material.law is None else f'law {material.law.law}'
        return f'nominal zeta {material.zeta:g}, {whose}, c1 {material.c1:g}'

    def actual(self, errors: Errors) -> Actual:
        """Return the actuator with errors."""
        return Actual.off(self.material, errors, self.delivery)

    def errors(self) -> Array:
        """Return the errors of a parameter in the curves, with 0 and both edges of the box."""
        grid = np.linspace(-self.span, self.span, _POINTS)
        grid[_POINTS // 2] = 0.0
        edges = np.array([-self.box, self.box])
        apart = np.abs(grid[:, np.newaxis] - edges).min(axis=1) > 1e-9
        return np.sort(np.concatenate([grid[apart], edges]))


@dataclass(frozen=True)
class Worst:
    """The largest residual over some errors, and its errors."""

    residual: float  #: as a fraction of the step; NaN if a motion could not be simulated
    errors: Errors


@dataclass(frozen=True)
class Result:
    """Result of one shaper in one case."""

    candidate: Candidate
    code: Code  #: differs from the shaper's own if it fell back or refused
    reason: str  #: reason for that
    move: Move | None  #: None if refused; the other fields are then empty or NaN
    arrival: float  #: nominal time from which the residual counts
    nominal: float  #: residual without errors
    curves: dict[str, Array]  #: by parameter: residuals for `Case.errors` of it alone
    alone: dict[str, Worst]  #: by parameter: worst residual of it alone, up to the box's edges
    worst: Worst  #: worst residual in the box of all three


def candidates(
        shapers: Sequence[str] | None = None,
        orders: Sequence[int] = ORDERS) -> tuple[Candidate, ...]:
    """Return the shapers to compare, each once, those in `ORDERED` with each order."""
    found = [
        Candidate(name, order)
        # Without secondary modes, modal is the two-step command.
        for name in ([x for x in SHAPERS if x != 'modal'] if shapers is None else shapers)
        for order in (orders if name in ORDERED else (2,))]
    return tuple(dict.fromkeys(found))


def study(case: Case, candidate: Candidate) -> Result:
    """Plan a move with the nominal parameters and carry it out with errors."""
    try:
        request = MoveRequest(
            State(case.start), case.target, case.material, case.limits, case.delivery,
            candidate.order, errors=(case.box, case.box, case.box))
        move = held(request, get_shaper(candidate.shaper)(request), math.inf)
    except RefusedError as error:
        return _refused(candidate, error.code, str(error))
    arrival = arrival_of(move, case.start, case.target, case.material)

    def left(errors: Errors) -> float:
        try:
            return case.actual(errors).residual(move, case.start, case.target, arrival)
        except BadInputError:
            raise
        except HmsaError:
            # Too close to a limiting stretch to simulate.
            return math.nan

    curves = {
        name: np.array([left(Errors(**{attribute: x})) for x in case.errors().tolist()])
        for name, attribute in case.parameters.items()}
    steps = np.linspace(-case.box, case.box, _BOX_POINTS).tolist()
    box = [Errors(*errors) for errors in product(
        *(steps if x in curves else [0.0] for x in PARAMETERS))]
    return Result(
        candidate, move.code, move.reason, move, arrival, left(Errors()), curves,
        _alone(case, curves), _worst(np.array([left(errors) for errors in box]), box))


def _refused(candidate: Candidate, code: Code, reason: str) -> Result:
    return Result(
        candidate, code, reason, None, math.nan, math.nan, {}, {}, Worst(math.nan, Errors()))


def _alone(case: Case, curves: Mapping[str, Array]) -> dict[str, Worst]:
    """Return the worst residual of each curve within the box."""
    grid = case.errors()
    inside = np.abs(grid) <= case.box
    return {
        name: _worst(curve[inside], [
            Errors(**{PARAMETERS[name]: x}) for x in grid[inside].tolist()])
        for name, curve in curves.items()}


def _worst(residuals: Array, errors: Sequence[Errors]) -> Worst:
    # argmax returns NaN as the largest, which is right here: nothing bounds it.
    index = int(np.argmax(residuals))
    return Worst(float(residuals[index]), errors[index])


# The column varied contains a parameter, or 'box' for the worst in the box; residual and offset,
# the steady-state error beyond the target, are fractions of the step.
_COLUMNS = (
    'start', 'target', 'zeta', 'j_lim', 'c1', 'shaper', 'order', 'status', 'varied',
    'error_G', 'error_zeta', 'error_J_lim', 'residual', 'offset')


def write_csv(path: Path, studies: Sequence[tuple[Case, Sequence[Result]]]) -> None:
    """Write all residuals, one per row, in full double precision; replace an old file."""
    write_rows(path, [_COLUMNS, *(
        row for case, results in studies for result in results for row in _rows(case, result))])


def _rows(case: Case, result: Result) -> Iterator[tuple[str | float, ...]]:
    order: int | str = result.candidate.order if result.candidate.shaper in ORDERED else ''
    fixed = (
        case.start, case.target, case.material.zeta, case.material.j_lim, case.material.c1,
        result.candidate.shaper, order, str(result.code))
    if result.move is None:
        yield *fixed, '', math.nan, math.nan, math.nan, math.nan, math.nan
        return
    points = [
        (name, Errors(**{PARAMETERS[name]: error}), value)
        for name, curve in result.curves.items()
        for error, value in zip(case.errors().tolist(), curve.tolist(), strict=True)]
    points.append(('box', result.worst.errors, result.worst.residual))
    for name, errors, value in points:
        offset = case.actual(errors).offset(result.move, case.start, case.target)
        yield (*fixed, name, errors.shear_modulus, errors.zeta, errors.j_lim, value, offset)


def comparison(tasks: Sequence[tuple[Case, Candidate]]) -> RowStudy:
    """Return a study of shapers in cases, whose rows `result_of` reads."""
    return RowStudy(_row, tasks, {
        **dict.fromkeys(('start', 'target', 'zeta', 'j_lim', 'c1', 'box', 'span'), 'double'),
        'shaper': 'string', 'order': 'int64', 'status': 'string', 'reason': 'string',
        'times': 'doubles', 'levels': 'doubles',
        **dict.fromkeys(('duration', 'arrival', 'nominal'), 'double'),
        **{f'residual_{x}': 'doubles' for x in PARAMETERS},
        **{f'error_{x}': 'double' for x in PARAMETERS}, 'residual': 'double'}, (1, 100))


def _row(case: Case, candidate: Candidate) -> dict[str, Any]:
    found = study(case, candidate)
    levels = () if found.move is None else found.move.levels
    return {
        'start': case.start, 'target': case.target, 'zeta': case.material.zeta,
        'j_lim': case.material.j_lim, 'c1': case.material.c1, 'box': case.box,
        'span': case.span, 'shaper': candidate.shaper, 'order': candidate.order,
        'status': str(found.code), 'reason': found.reason,
        'times': [x.time for x in levels], 'levels': [x.load for x in levels],
        'duration': math.nan if found.move is None else found.move.duration,
        'arrival': found.arrival, 'nominal': found.nominal,
        **{f'residual_{x}': found.curves[x].tolist() if x in found.curves else []
           for x in PARAMETERS},
        **{f'error_{x}': getattr(found.worst.errors, y) for x, y in PARAMETERS.items()},
        'residual': found.worst.residual}


def result_of(case: Case, candidate: Candidate, row: Mapping[str, Any]) -> Result:
    """Return the result of `study` from the row of a table."""
    code, reason = Code(row['status']), row['reason']
    if not row['times']:
        return _refused(candidate, code, reason)
    levels = tuple(map(Level, row['times'], row['levels']))
    curves = {x: np.array(row[f'residual_{x}'], dtype=np.float64) for x in case.parameters}
    return Result(
        candidate, code, reason, Move(code, levels, row['duration'], reason), row['arrival'],
        row['nominal'], curves, _alone(case, curves), Worst(
            row['residual'], Errors(*(row[f'error_{x}'] for x in PARAMETERS))))
