"""
Plans for a sequence of setpoints (Eq. 14), each from the true end state of the previous one.

They tell the vibration that their commands leave in an actuator with secondary modes. Only `modal`
brings other modes than the first to rest, if they ring. Other shapers plan the first mode, and
what their levels do to the others remains after the move.
"""

from bisect import bisect_right
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa import motion
from hmsa.errors import check_choice, HmsaError
from hmsa.model import law
from hmsa.model.delivery import ramps
from hmsa.model.equations import Array, elastic_force, natural_frequency
from hmsa.model.laws.record import ENDLESS
from hmsa.model.moves import Level, Move, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import follow, longest_motion, observed, sampled
from hmsa.model.status import Code, RefusedError
from hmsa.motion import STRETCH
from hmsa.planning.shapers import creeping, get_shaper
from hmsa.planning.shapers.modal import weak_vibration
from hmsa.planning.shapers.request import MoveRequest, Shaper, StepBudget

# Samples of the first period after a move, and their tolerance.
_SAMPLED, _RTOL = 100, 1e-7
#: Vibration in fractions of the move below which nothing is told.
TOLD = 5e-4
# The same from which another shaper is advised, and from which that of an unshaped step is
# computed, which may be less.
_MUCH, _LIKE_A_STEP = 1e-2, 0.4
# That after `modal` from which a higher order is advised (benchmarks continuum).
_MUCH_OF_MODAL = 2e-2
# Smaller moves have no meaningful fractions.
_LEAST_MOVE = 1e-6
#: Options for a setpoint that ends before the move to it.
SHORT_SPELL = ('refuse', 'continue')
# Samples of a motion, and their tolerance, for the check against the limits of its model.
_LOOK, _LOOK_RTOL = 300, 1e-7


@dataclass(frozen=True)
class Remaining:
    """Vibration in the first period after a move, peak to peak, as fractions of the move."""

    vibration: float
    mode: int  #: number of the mode that contributes most, from 1
    ratio: float  #: of its frequency to that of the first
    broad: bool = False  #: whether this stands for all weak modes together
    #: Vibration of an unshaped step to the same target if that is less, else NaN.
    step: float = math.nan

    @property
    def worse(self) -> bool:
        """Whether an unshaped step leaves less."""
        return not math.isnan(self.step)

    def of(self, target: float, code: Code) -> str:
        """Return a sentence about the move to a target."""
        at = f'at {self.ratio:.3g} times the first frequency'
        by = ('the first mode' if self.mode == 1 else f'weak modes {at}' if self.broad
              else f'mode {self.mode} {at}')
        text = (
            f'the move to {target:g} by {code} leaves a vibration of {_percent(self.vibration)} '
            f'of the move, most of it in {by}')
        if self.worse:
            return (f'{text}, and an unshaped step {_percent(self.step)}: expected the shaper '
                    'modal, which leaves least, or two_step')
        if code is Code.MODAL:
            return text + (
                ': a higher robust_order leaves less' if self.vibration >= _MUCH_OF_MODAL else '')
        return text + (': shaper modal leaves less' if self.vibration >= _MUCH else '')


def _percent(fraction: float) -> str:
    percent = 100.0 * fraction
    return f'{percent:.2g} %' if percent < 10.0 else f'{percent:.0f} %'


def remaining(request: MoveRequest, move: Move) -> Remaining | None:
    """
    Return what a move with secondary modes leaves; None if it is less than is told.

    `modal` may bring all modes to rest.
    """
    modes = request.material.modes
    size = abs(request.target - request.state.stretch)
    if size < _LEAST_MOVE or move.code is Code.HOLD or (
            move.code is Code.MODAL and request.material.ringing is request.material):
        return None
    if move.code is Code.MODAL:
        vibration, weak = weak_vibration(request, move)
        return None if vibration < TOLD * size else Remaining(
            vibration / size, weak + 2, modes.ratios[weak], broad=True)
    half = math.pi / request.frequency
    start = move.duration if move.duration < math.inf else move.levels[-1].time + half
    seen = _after(request, move.levels, start, 2.0 * half)
    if seen is None:
        return None
    rows, whole = seen
    parts = np.abs(modes.at(request.target)) * np.ptp(rows, axis=1)
    most, vibration = int(np.argmax(parts)), float(np.ptp(whole)) / size
    if vibration < TOLD:
        return None
    step = math.nan
    if vibration > _LIKE_A_STEP and move.code is not Code.STEP:
        there = _after(request, [Level(0.0, request.holding_load())], half, 2.0 * half)
        left = math.inf if there is None else float(np.ptp(there[1])) / size
        step = left if left < vibration else math.nan
    broad = most > 0 and most - 1 not in modes.ringing
    return Remaining(vibration, most + 1, (1.0, *modes.ratios)[most], broad, step)


def _after(
        request: MoveRequest, levels: Sequence[Level], start: float,
        duration: float) -> tuple[list[Array], Array] | None:
    """Return the positions of all modes, and the stretch, after a time; None if it diverges."""
    material = request.material
    times = np.linspace(start, start + duration, _SAMPLED, dtype=np.float64)
    try:
        found = sampled(levels, request.start, times, material, request.delivery, _RTOL)
    except HmsaError:
        return None
    own = motion.FOLLOWED + len(material.branches)
    return [found[motion.STRETCH], *found[own::2]], observed(found, material)[0]


@dataclass(frozen=True)
class Segment:
    """One setpoint of a plan."""

    setpoint: Setpoint
    begin: float  #: start of the move, from the start of the sequence
    start: State  #: predicted at begin
    end: State  #: predicted at the end of the setpoint, or after the last change of level
    move: Move  #: its times count from begin
    holding: float  #: load that holds the stretch after creep
    #: Vibration of an actuator with secondary modes after the move; None for none.
    left: Remaining | None = None

    @property
    def shaped(self) -> bool:
        """Whether another level comes before the one that holds the target."""
        return len(self.move.levels) > max(len(self.move.tail), 1)

    @property
    def held(self) -> float:
        """Load at the end of the move; with creep, its limit for long times."""
        return self.holding if self.move.tail else self.move.levels[-1].load

    def notes(self) -> list[str]:
        """Return deviations from the request, one sentence each."""
        move = self.move
        found = [move.reason] if move.reason else []
        if self.left is not None:
            found.append(self.left.of(self.setpoint.stretch, move.code))
        if move.tail:
            step = abs(self.setpoint.stretch - self.start.stretch) or 1.0
            found.append(
                f'{len(move.tail)} levels follow creep at stretch {self.setpoint.stretch:g}; they '
                f'leave a vibration of at most {100.0 * move.vibration / step:.2g} % of the move')
        return found


def plan_sequence(
        setpoints: Sequence[Setpoint], frame: MoveRequest | NondimensionalParameters,
        shaper: str | Shaper = 'two_step', short_spell: str = 'refuse') -> tuple[Segment, ...]:
    """
    Plan a sequence of setpoints.

    Parameters
    ----------
    setpoints : sequence of Setpoint
        At least one.
    frame : MoveRequest or NondimensionalParameters
        Common data of all moves, with the initial state; or only a material, to start at rest
        without a field on ideal hardware. With a command period, durations must be multiples of
        it. Each move starts from the state that the rounded command reaches.
    shaper : str or Shaper
        A shaper or its name.
    short_spell : {'refuse', 'continue'}
        For a duration that ends before the move: refuse, or plan the next move from the state
        reached by then; the last move is completed after its duration.

    Returns
    -------
    tuple of Segment
        One per setpoint.

    Raises
    ------
    RefusedError
        If a setpoint cannot be reached; the message names it.
    BadInputError
        If an argument is out of range.

    """
    if not setpoints:
        raise RefusedError(Code.BAD_INPUT, 'no setpoint given: expected at least one')
    check_choice('short_spell', short_spell, SHORT_SPELL)
    begin = frame if isinstance(frame, MoveRequest) else MoveRequest.of(frame)
    shape = get_shaper(shaper) if isinstance(shaper, str) else shaper
    return tuple(segments(begin, setpoints, shape, short_spell))


def segments(
        frame: MoveRequest, setpoints: Iterable[Setpoint], shaper: Shaper, short_spell: str, *,
        first: Shaper | None = None) -> Generator[Segment, None, None]:
    """
    Plan one setpoint after another; the first may have its own shaper.

    The frame gives the initial state and all fields of the moves except state and target. Raise
    `RefusedError` if a setpoint cannot be reached, `BadInputError` if an argument is out of range.
    """
    shape = first or shaper
    units, state, rounded = frame.units, frame.state, frame.delivery.rounded
    frame.material.check(state.stretch, 'start stretch')
    begin = 0.0
    upcoming = iter(setpoints)
    setpoint = next(upcoming, None)
    while setpoint is not None:
        following = next(upcoming, None)
        request = replace(frame, state=state, target=setpoint.stretch, work=StepBudget())
        move = shape(request)
        # With times that commands can have.
        move = Move(
            move.code, tuple(Level(rounded(x.time), x.load) for x in move.levels),
            rounded(move.duration), move.reason)
        if frame.material.creeps:
            move = creeping.held(
                request, move, math.inf if following is None else setpoint.span)
        # Both are rounded: a duration that the move fills exactly is long enough.
        if setpoint.span * (1.0 + 1e-12) < move.duration < math.inf:
            if short_spell == 'refuse':
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'the move from {units.coordinate} {state.stretch:.6g} to '
                    f'{setpoint.stretch:g} takes {units.time_text(move.duration)}, its setpoint '
                    f'lasts {units.time_text(setpoint.span)}: expected a duration at least as '
                    'long as the move')
            move = _cut(request, move, setpoint.span, last=following is None)
        end = _follow(request, move, setpoint.span)
        if following is not None and move.tail:
            move = move.until(setpoint.span)
        yield Segment(
            setpoint, begin, state, end, move,
            float(law.elastic_force(setpoint.stretch, frame.material.packed)),
            remaining(request, move) if frame.material.modes.ratios else None)
        begin += setpoint.span
        state = end
        setpoint = following
        shape = shaper


def _cut(request: MoveRequest, move: Move, span: float, *, last: bool) -> Move:
    """Return a move that is cut at the end of its setpoint; the last one is completed."""
    units = request.units
    return (move if last else move.until(span))._replace(
        code=Code.SPELL_TOO_SHORT,
        duration=move.duration if last else math.inf,
        reason=f'the duration {units.time_text(span)} ends before {request.named_target} is '
        f'reached, which takes {units.time_text(move.duration)}')


def _follow(request: MoveRequest, move: Move, span: float) -> State:
    """Return the state at the end of a duration, or at the end of the last ramp."""
    material, delivery, start = request.material, request.delivery, request.start
    end = move.levels[-1].time if math.isinf(move.duration) else move.duration
    if math.isfinite(span):
        end = max(end, span)
    if move.tail:
        # The motion of the branches after the arrival is known.
        if move.duration > 0.0 and material.law is not None:
            _check_known(request, move.until(move.duration).levels, (move.duration,) * 2)
        place = bisect_right(move.levels, end, key=lambda x: x.time) - 1
        level = move.levels[place]
        return follow(
            (level._replace(time=0.0),), move.tail[place - len(move.levels)], end - level.time,
            material, delivery)
    parts, last = ramps(move.levels, start.ramps_from, end, delivery.slew)
    ramped = max(parts[-1][0], 0.0)
    if material.law is not None:
        # A move held without an end also vibrates after the last level.
        _check_known(request, move.levels, (ramped, max(end, span)))
    if not material.creeps:
        if move.code is Code.MODAL:
            # This is what has been solved for; to follow all modes again takes time.
            return State(
                request.target, 0.0, last, last if delivery.lag > 0.0 else None,
                (request.target, 0.0) * len(material.modes.ratios))
        end = min(end, ramped + longest_motion(last, material) + delivery.lagging)
    return follow(move.levels, start, end, material, delivery)


def _check_known(request: MoveRequest, levels: Sequence[Level], ends: tuple[float, float]) -> None:
    """
    Refuse a move that leaves the range of the elastic model, or collapses.

    ``ends`` are the times of the last ramp and of the end of the check.
    """
    material, target = request.material, request.target
    elastic, limits = material.law, material.limits
    if elastic is None or limits == ENDLESS:
        return
    # Stretches from which the elastic force decreases, unless the range of the model ends there.
    falls = [x if x != y else z for x, y, z in zip(
        limits, elastic.limits, (-math.inf, math.inf), strict=True)]
    where = f'{material.coordinate.name} {request.state.stretch:.6g}'
    # The first swing about the last level is the widest.
    swing = 2.0 * math.pi / float(natural_frequency(target, material))
    times = np.linspace(
        levels[0].time, min(ends[1], ends[0] + swing), _LOOK, dtype=np.float64)
    try:
        stretch = sampled(
            levels, request.start, times, material, request.delivery, _LOOK_RTOL)[STRETCH]
        # Where the elastic force decreases below the last load, nothing brings it back.
        after = stretch[times >= ends[0]]
        pull = levels[-1].load - elastic_force(after, material)
        lost = bool(np.any(
            (after > falls[1]) & (pull > 0.0) | (after < falls[0]) & (pull < 0.0)))
    except HmsaError:
        # Without limiting extensibility, the motion diverges.
        lost = True
    if lost:
        raise RefusedError(
            Code.OUT_OF_RANGE,
            f'the move from {where} to {target:g} overshoots beyond what the model can simulate: '
            'expected a smaller move, or a shaper that does not overshoot, such as two_step')
    for widest, beyond in ((np.min(stretch), -1.0), (np.max(stretch), 1.0)):
        limit = elastic.limits[beyond > 0.0]
        if beyond * (widest - limit) > 0.0:
            raise RefusedError(
                Code.OUT_OF_RANGE,
                f'the move from {where} to {target:g} '
                f'swings to {widest:.4f}: expected a motion between the limits '
                f'{elastic.limits[0]:.4f} and {elastic.limits[1]:.4f} of law {elastic.law}, '
                'outside which it is not defined')
