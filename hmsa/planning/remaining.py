"""
Vibration that a command leaves in an actuator with secondary modes.

Only `modal` brings other modes than the first to rest, if they ring. Other shapers plan the first
mode, and what their levels do to the others remains after the move.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa import motion
from hmsa.errors import HmsaError
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import observed, sampled
from hmsa.model.status import Code
from hmsa.planning.shapers.request import MoveRequest

# Samples of the first period after a move, and their tolerance.
_LOOK, _RTOL = 100, 1e-7
# Vibration in fractions of the move below which nothing is told, and from which another shaper is
# advised; and that which an unshaped step leaves at least, so that only then it is computed.
_TOLD, _MUCH, _LIKE_A_STEP = 5e-4, 1e-2, 0.4
# Smaller moves have no meaningful fractions.
_LEAST_MOVE = 1e-6


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
        return text + (': shaper modal leaves less' if self.vibration >= _MUCH and (
            code is not Code.MODAL) else '')


def _percent(fraction: float) -> str:
    percent = 100.0 * fraction
    return f'{percent:.2g} %' if percent < 10.0 else f'{percent:.0f} %'


def remaining(request: MoveRequest, move: Move) -> Remaining | None:
    """
    Return what a move leaves; None without secondary modes, and if `modal` brings all to rest.

    A move that only approaches its target has none either, unless secondary modes vibrate.
    """
    modes = request.material.modes
    size = abs(request.target - request.state.stretch)
    if not modes or size < _LEAST_MOVE or move.code is Code.HOLD or (
            move.code is Code.MODAL and request.material.ringing is request.material):
        return None
    half = math.pi / request.frequency
    start = move.duration if move.duration < math.inf else move.levels[-1].time + half
    seen = _after(request, move.levels, start, 2.0 * half)
    if seen is None:
        return None
    rows, whole = seen
    parts = [abs(x) * np.ptp(y) for x, y in zip(modes.at(request.target), rows, strict=True)]
    most, vibration = int(np.argmax(parts)), float(np.ptp(whole)) / size
    if vibration < _TOLD:
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
    times = np.linspace(start, start + duration, _LOOK, dtype=np.float64)
    try:
        found = sampled(levels, request.start, times, material, request.delivery, _RTOL)
    except HmsaError:
        return None
    own = motion.FOLLOWED + len(material.branches)
    return [found[motion.STRETCH], *found[own::2]], observed(found, material)[0]
