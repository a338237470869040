"""
Hysteresis of an iron core, and its compensation.

The model is that of Prandtl and Ishlinskii with generalised play operators, whose envelope is the
curve of the coil (Al Janaideh, Rakheja and Su 2011, doi:10.1109/TMECH.2010.2052366). Its inverse
is exact (Kuhnen 2003, doi:10.3166/ejc.9.407-418): for a given state of the plays, the field is an
increasing, piecewise linear function of the level.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array

# Number of levels stored, so that later ones can replace some of them, and rounding in ns of their
# times by a device.
_REMEMBERED, _ROUNDED = 1024, 100_000
# Widths for each level of a quarter of a staircase, and fraction of the range below which levels
# are equal.
_FINE, _SAME = 2, 1e-6
# Negligible weight, as a fraction of the first one.
_LEAST = 1e-9


@dataclass(frozen=True, eq=False)
class IronCore:
    """
    Play operators of an iron core.

    Parameters
    ----------
    widths : sequence of float
        Change of the level in T before a play follows; increasing from 0.
    weights : sequence of float
        Weights of the plays in the field; at least 0, the first one above 0.

    Raises
    ------
    BadInputError
        If they do not meet these conditions.

    """

    widths: Sequence[float]
    weights: Sequence[float]
    _arrays: tuple[Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        try:
            widths, weights = (np.array(x, dtype=np.float64) for x in (self.widths, self.weights))
            fits = (widths.ndim == 1 and widths.shape == weights.shape and widths[0] == 0.0
                    and np.all(np.diff(widths) > 0.0) and weights[0] > 0.0
                    and np.all(weights >= 0.0) and np.all(np.isfinite([widths, weights])))
        except (TypeError, ValueError, IndexError):
            fits = False
        if not fits:
            raise BadInputError(
                f'coil.play_widths is {self.widths!r:.80} and coil.play_weights '
                f'{self.weights!r:.80}: expected as many numbers of both, rising from 0, and at '
                'least 0 with the first one above 0; hmsa calibrate coil --hysteresis writes them')
        object.__setattr__(self, '_arrays', (widths, weights))

    def moved(self, plays: Array, level: float) -> Array:
        """Return the state of plays, shape (n,), after a level in T."""
        widths, _ = self._arrays
        found: Array = np.clip(plays, level - widths, level + widths)
        return found

    def field(self, plays: Array) -> float:
        """Return the field in T for a state of the plays."""
        return float(self._arrays[1] @ plays)

    def needed(self, plays: Array, flux: float) -> float:
        """Return the level in T that gives a field in T."""
        widths, weights = self._arrays
        turns = np.sort(np.concatenate([plays - widths, plays + widths]))
        fields = np.array([self.field(self.moved(plays, x)) for x in turns])
        if fields[0] < flux < fields[-1]:
            return float(np.interp(flux, fields, turns))
        # Outside, all plays follow.
        end = 0 if flux <= fields[0] else -1
        return float(turns[end] + (flux - fields[end]) / np.sum(weights))


class _Step(NamedTuple):
    stamp: int
    field: float
    level: float
    plays: Array


class Compensation:
    """
    State of a core after each of its levels, including pending ones; times in ns.

    The core is assumed demagnetised initially.
    """

    def __init__(self, core: IronCore) -> None:
        self._core = core
        self._steps = [_Step(-2**63, 0.0, 0.0, np.zeros(len(core.widths)))]

    def ask(self, stamp: int, field: float, *, off: bool = False) -> float:
        """Return the level in T for a field in T from a timestamp on; later levels are dropped."""
        keep = max(bisect_right(self._steps, stamp - 1, key=lambda x: x.stamp), 1)
        self._steps = self._steps[max(keep - _REMEMBERED, 0):keep]
        plays = self._steps[-1].plays
        level = 0.0 if off else self._core.needed(plays, field)
        self._steps.append(_Step(stamp, field, level, self._core.moved(plays, level)))
        return level

    def field_of(self, stamp: int, level: float, tolerance: float) -> float:
        """Return the requested field in T for a level that took effect by a timestamp."""
        until = max(bisect_right(self._steps, stamp + _ROUNDED, key=lambda x: x.stamp), 1)
        # A late level may take effect after the time of the next one.
        past = self._steps[:until]
        step = next((x for x in reversed(past) if abs(x.level - level) <= tolerance), past[-1])
        return step.field + level - step.level


def fit_core(level: Array, field: Array) -> tuple[IronCore, float]:
    """
    Fit a core to a staircase of levels.

    Parameters
    ----------
    level, field : ndarray, shape (n,)
        Levels in T in chronological order, such as up to a maximum, down to its negative and back,
        and the reading of the field in T at each; readings before the maximum are ignored.

    Returns
    -------
    (IronCore, float)
        The core, and the largest deviation of a reading from it, as a fraction of the range.

    Raises
    ------
    BadInputError
        If the levels do not have both signs, or the field does not increase with them.

    """
    from scipy.optimize import nnls  # not needed by a driver

    largest = float(np.max(np.abs(level))) if len(level) else 0.0
    first = int(np.argmax(level)) if len(level) else 0
    steps = len(np.unique(np.round(level[level > _SAME * largest] / (_SAME * largest)))) if (
        largest > 0.0) else 0
    if steps < 2 or not np.min(level[first:]) < 0.0 or len(level) - first <= 2 * steps:
        raise BadInputError(
            f'{len(level)} readings up to {largest:g} T: expected a loop from the largest current '
            'to its negative and back, for the hysteresis')
    widths = np.linspace(0.0, largest, _FINE * steps, endpoint=False)
    plays, rows = np.clip(0.0, level[first] - widths, level[first] + widths), []
    for x in level[first:]:
        plays = np.clip(plays, x - widths, x + widths)
        rows.append(plays)
    seen = field[first:] - np.mean(field[first:])
    table = np.array(rows) - np.mean(rows, axis=0)
    weights, _ = nnls(table, seen)
    if not weights[0] > 0.0:
        raise BadInputError(
            'the field does not rise with the current after a reversal: expected one that does; '
            'raise --settle or --steps')
    used = weights > _LEAST * weights[0]
    left = float(np.max(np.abs(table @ weights - seen))) / float(np.ptp(seen))
    return IronCore(tuple(widths[used].tolist()), tuple(weights[used].tolist())), left
