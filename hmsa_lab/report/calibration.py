"""Draw calibrations: the measurements as points, and the fit as a line."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmsa.identification.delays import Delays, response
from hmsa.model.equations import Array
from hmsa.report import style
from hmsa.report.looks import BLACK
from hmsa.report.paper import Paper
from hmsa_lab.bench.calibration import CoilCalibration
from hmsa_lab.bench.statics import Statics

_LINE = 400
# End of the figure in lags after the transport delay, and its minimum in s.
_LAGS, _SHORTEST = 8.0, 2e-3


def _draw(
        paths: Sequence[Path], axes: tuple[str, str], points: tuple[Array, Array],
        line: tuple[Array, Array], paper: Paper) -> None:
    with style.picture(paths, 2.8 * paper.letters / 8.0, paper) as figure:
        panel = figure.subplots()
        panel.plot(*line, **style.SHAPED, label='fit')
        panel.plot(*points, linestyle='none', marker='o', markersize=2.5, color=BLACK, zorder=4,
                   label='measured')
        style.finish(panel, *axes)
        style.legend_below(figure)


def draw_coil(
        paths: Sequence[Path], current: Array, flux_density: Array, found: CoilCalibration,
        paper: Paper) -> None:
    """Draw readings in T over currents in A, and the mean at each."""
    _draw(paths, (style.axis('current', 'I', 'A'), style.axis('flux density', 'B', 'mT')),
          (current, 1e3 * flux_density),
          (found.current, 1e3 * (found.flux_density + found.offset)), paper)


def draw_delays(paths: Sequence[Path], found: Delays, paper: Paper) -> None:
    """Draw the response of the field to its level; without a probe, the stretch and its fit."""
    seen = found.field
    if seen is None:
        motion = found.motion
        _draw(paths, (style.axis('time', 't', 's'), style.axis('stretch', r'\lambda')),
              (motion.recording.time, motion.recording.stretch),
              (motion.recording.time, motion.fit.response.stretch), paper)
        return
    end = max(seen.transport.value + _LAGS * seen.lag.value, _SHORTEST)
    since, near = np.linspace(0.0, end, _LINE, dtype=np.float64), seen.since <= end
    _draw(paths, (style.axis('time since the level', unit='ms'), 'fraction of the step'),
          (1e3 * seen.since[near], seen.share[near]),
          (1e3 * since, response(since, seen.transport.value, seen.lag.value)), paper)


def draw_statics(
        paths: Sequence[Path], level: Array, stretch: Array, found: Statics,
        paper: Paper) -> None:
    """Draw stretches over levels in T, and the mean of both branches."""
    _draw(paths, (style.axis('flux density', 'B', 'mT'), style.axis('stretch', r'\lambda')),
          (1e3 * level, stretch / found.rest), (1e3 * found.level, found.stretch), paper)
