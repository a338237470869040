"""
Secondary modes in the residuals of a fit.

A mode of the actuator is an oscillator about the rest under each level, so that its motion follows
from its frequency ratio and its damping ratio alone. The difference between its motion and that of
the first mode, of which the residuals contain the share, is computed for all ratios and several
dampings, and compared with the residuals as in `hmsa.identification.defects`. The strongest line
is refined, its columns join those that the fit explains, and the search is repeated. Lines may be
broad or close to the first mode, and samples need not be evenly spaced.
"""

from collections.abc import Collection
from dataclasses import dataclass
import math

import numpy as np

from hmsa import motion
from hmsa.identification import quantities
from hmsa.identification.fit import Fit
from hmsa.identification.measurement import Measurement, pieces
from hmsa.identification.response import ResponseArguments
from hmsa.model.equations import Array
from hmsa.motion import theta as places

#: Minimum ratio to the frequency of the first mode.
LEAST_RATIO = 1.1
_MOST_RATIO = 12.0
# Ratio of neighbouring frequencies of the search, and its damping ratios.
_SPACING = 1.03
_DAMPINGS = (0.03, 0.1, 0.3)
# Grids of the refinement: steps in the logarithms of both, and how often they shrink.
_STEPS, _REFINED, _SHRINK = np.linspace(-1.0, 1.0, 5), 4, 0.45
_LEAST_DAMPING, _MOST_DAMPING = 0.002, 0.6
# Samples a period that resolve a line.
_RESOLVED = 2.5
# Minimum size of a line in standard deviations, and of the part of the residuals that it explains.
_DEVIATIONS, _PART = 6.0, 0.04
# Steps a period in which a field that does not step is replaced by one that does.
_PIECES = 24.0
_MOST_SAMPLES = 2000


@dataclass(frozen=True)
class Line:
    """A secondary mode that the residuals show."""

    ratio: float  #: of its frequency to that of the first mode
    damping: float  #: damping ratio
    share: float  #: of the static stretch
    explained: float  #: fraction of the residuals' sum of squares, 0 to 1


def highest_ratio(recording: Measurement, own: float) -> float:
    """Return the highest ratio, to a frequency in Hz, that samples resolve."""
    return min(1.0 / (_RESOLVED * recording.gap * own), _MOST_RATIO)


def lines_of(
        fit: Fit, own: float, most: int, without: Collection[str] = ()
) -> tuple[list[Line], float]:
    """
    Return the secondary modes in the residuals of a fit, the strongest first.

    Parameters
    ----------
    fit : Fit
        A fit of the first mode, or of several.
    own : float
        Frequency of the first mode about rest in Hz.
    most : int
        Maximum number of lines.
    without : collection of str
        Free parameters whose effect counts as residual, to compare them with a mode.

    Returns
    -------
    lines : list of Line
        The lines.
    by_others : float
        Fraction of these residuals' sum of squares that the parameters ``without`` explain.

    """
    highest = highest_ratio(fit.recording, own)
    if highest <= LEAST_RATIO * _SPACING:
        return [], 0.0
    residual, base = _residual(fit, without)
    left = _without(base, residual)
    total = float(left @ left)
    if total == 0.0:
        return [], 0.0
    by_others = 1.0 - float(np.sum((fit.root * fit.residual) ** 2)) / total
    modes = _Modes.of(fit, own)
    ratios = np.exp(np.arange(
        math.log(LEAST_RATIO), math.log(highest), math.log(_SPACING), dtype=np.float64))
    grid = np.array([(x, y) for y in _DAMPINGS for x in ratios.tolist()])
    # A thinned copy for the search.
    thin = slice(None, None, max(len(residual) // _MOST_SAMPLES, 1))
    table = modes.columns(grid, thin)
    lines = list[Line]()
    for _ in range(most):
        start = grid[int(np.argmax(_scores(base[thin], table, residual[thin])))]
        ratio, damping = _refined(modes, base[thin], residual[thin], thin, start, highest)
        column = modes.columns(np.array([(ratio, damping)]))
        direction = _without(base, column)[:, 0]
        norm = float(direction @ direction)
        size = float(direction @ residual) / max(norm, 1e-300)
        part = size ** 2 * norm
        rest = max(float(left @ left) - part, 1e-300)
        if part < _PART * float(left @ left) or part * len(left) < _DEVIATIONS ** 2 * rest:
            break
        lines.append(Line(ratio, damping, size, part / total))
        base = np.hstack([base, column])
        left = _without(base, residual)
    return lines, by_others


def _residual(fit: Fit, without: Collection[str]) -> tuple[Array, Array]:
    """Return weighted residuals with the effect of some parameters, and the other columns."""
    values, jacobian = fit.values, fit.response.jacobian
    residual, kept = fit.residual.copy(), list[int]()
    for j, name in enumerate(fit.free):
        if name in without:
            usual = quantities.quantity_of(name).default
            residual += jacobian[:, j] * (values[name] - usual) / quantities.derivative(
                name, values[name])
        else:
            kept.append(j)
    base = fit.root[:, None] * np.hstack([jacobian[:, kept], fit.response.by_switch])
    return fit.root * residual, base


def _without(base: Array, of: Array) -> Array:
    """Return columns without what the base explains."""
    scale = np.maximum(np.linalg.norm(base, axis=0), 1e-300)
    base = base / scale
    gram = base.T @ base
    solved = np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)))
    found = of
    for _ in range(2):
        found = found - base @ (solved @ (base.T @ found))
    return found


def _scores(base: Array, columns: Array, residual: Array) -> Array:
    """Return the sums of squares that columns explain beyond the base."""
    directions = _without(base, columns)
    norms = np.linalg.norm(directions, axis=0)
    found: Array = np.where(
        norms > 1e-4 * np.linalg.norm(columns, axis=0),
        (directions.T @ residual) / np.maximum(norms, 1e-300), 0.0) ** 2
    return found


def _refined(
        modes: '_Modes', base: Array, residual: Array, thin: slice, start: Array,
        highest: float) -> tuple[float, float]:
    """Return ratio and damping of the best line near a start."""
    ratio, damping = start.tolist()
    width, deep = math.log(_SPACING), 1.0
    for _ in range(_REFINED):
        grid = np.array([
            (min(max(ratio * math.exp(width * x), LEAST_RATIO), highest),
             min(max(damping * math.exp(deep * y), _LEAST_DAMPING), _MOST_DAMPING))
            for x in _STEPS for y in _STEPS])
        score = _scores(base, modes.columns(grid, thin), residual)
        ratio, damping = grid[int(np.argmax(score))].tolist()
        width, deep = _SHRINK * width, _SHRINK * deep
    return ratio, damping


@dataclass(frozen=True, eq=False)
class _Modes:
    """The field of a recording in steps, and what the first mode does."""

    time: Array  # of the motion that a sample shows, shape (n,)
    first: Array  # stretch of the first mode, shape (n,)
    weight: Array  # of each sample, times the gain of the sensor, shape (n,)
    begins: Array  # shape (m,), in s
    rests: Array  # shape (m,)
    frequencies: Array  # natural frequency of the first mode about each rest in 1/s, shape (m,)

    @classmethod
    def of(cls, fit: Fit, own: float) -> '_Modes':
        """Return the field and the first mode of a fit."""
        recording, values = fit.recording, fit.values
        setup = ResponseArguments.of(values, ())
        times = recording.time - values['sensor_latency']
        begin = float(min(recording.time[0], times[0]))
        if recording.at_rest:
            begin = min(begin, float(recording.level_times[0]))
        begins, levels, slopes = pieces(
            recording.level_times, recording.levels, recording.slew_limit, begin)
        lag = values['coil_time_constant']
        if lag > 0.0 or np.any(slopes):
            begins, levels = _stepped(begins, levels, slopes, lag, float(times[-1]), own)
        fields, which = np.unique(levels, return_inverse=True)
        sparse = fields if len(fields) < 100 else np.linspace(fields[0], fields[-1], 100)
        nothing: Array = np.empty(0)
        held = np.array([motion.rest(
            setup.theta, setup.material, float(x), setup.wanted, nothing) for x in sparse])
        pace = math.sqrt(float(setup.theta[places.STIFFNESS])) * np.array([
            motion.natural_frequency(float(x), setup.material) for x in held])
        if sparse is not fields:
            held, pace = (np.interp(fields, sparse, x) for x in (held, pace))
        gain = values['stretch_gain']
        return cls(
            times, (fit.response.stretch - values['stretch_bias']) / gain, fit.root * gain,
            begins, held[which], pace[which])

    def columns(self, grid: Array, part: slice = slice(None)) -> Array:
        """
        Return the change of samples by the share of modes, shape (n, g).

        ``grid`` has their frequency ratios and damping ratios, shape (g, 2).
        """
        time = self.time[part]
        places_of = np.searchsorted(self.begins, time, side='right').clip(1) - 1
        edges = np.searchsorted(places_of, np.arange(len(self.begins) + 1))
        found = np.empty((len(time), len(grid)))
        apart: Array = np.zeros(len(grid))  # from rest
        speed: Array = np.zeros(len(grid))
        for i, begin in enumerate(self.begins.tolist()):
            decay = grid[:, 1] * grid[:, 0] * self.frequencies[i]
            pace = grid[:, 0] * self.frequencies[i] * np.sqrt(1.0 - grid[:, 1] ** 2)
            sine = (speed + decay * apart) / pace
            here = slice(edges[i], edges[i + 1])
            since = time[here, None] - begin
            found[here] = self.rests[i] + np.exp(-decay * np.maximum(since, 0.0)) * (
                apart * np.cos(pace * since) + sine * np.sin(pace * since))
            if i + 1 < len(self.begins):
                span = self.begins[i + 1] - begin
                fade, cosine, sines = (
                    np.exp(-decay * span), np.cos(pace * span), np.sin(pace * span))
                after = fade * (apart * cosine + sine * sines)
                speed = fade * (pace * (sine * cosine - apart * sines)) - decay * after
                apart = after + self.rests[i] - self.rests[i + 1]
        return self.weight[part, None] * (found - self.first[part, None])


def _stepped(
        begins: Array, levels: Array, slopes: Array, lag: float, end: float, own: float
) -> tuple[Array, Array]:
    """Return a field that ramps or lags as one in short steps."""
    step = 1.0 / (_PIECES * own)
    count = max(int((end - begins[0]) / step), 1)
    edges: Array = begins[0] + step * np.arange(count)
    middle = edges + 0.5 * step
    place = np.searchsorted(begins, middle, side='right') - 1
    ahead = levels[place] + slopes[place] * (middle - begins[place])
    if lag > 0.0:
        kept, field = math.exp(-step / lag), float(levels[0])
        for i, level in enumerate(ahead.tolist()):
            field = level + (field - level) * kept
            ahead[i] = field
    return edges, ahead
