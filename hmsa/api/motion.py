"""A simulated or recorded motion: samples, levels and report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa.api.arguments import file_of, number, several, suggesting, whole
from hmsa.columns import read_only, UNITS
from hmsa.errors import BadInputError, check_choice, excerpt, meant
from hmsa.interfaces.diagnostics import Outcome
from hmsa.model.equations import Array
from hmsa.model.simulation import longest_motion, response
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import (
    described,
    levels_of,
    RecordedLevel,
    Run,
    samples_of,
    write_run,
)
from hmsa.table import dataset, frame, Table

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.api.plan import Plan

# Default sampling rate in Hz, and minimum number of samples per natural period.
_RATE, _A_PERIOD = 1000.0, 40.0
_MOST_SAMPLES = 5_000_000
# Time between sending and start of a simulated sequence, in ns.
_AHEAD = 50_000_000


@dataclass(frozen=True, eq=False)
class Motion:
    """
    Samples of a motion, and the field levels that drove it.

    `read` returns a recorded motion; `Plan.simulate` and `Actuator.simulate` simulate one. Its
    arrays are read-only: copy an array to change it.

    Examples
    --------
    >>> from hmsa import Actuator
    >>> motion = Actuator().plan([(1.1, 0.2)]).simulate(rate=500.0)
    >>> len(motion.times), round(float(motion.stretches[-1]), 6)
    (101, 1.1)

    """

    run: Run  #: the whole record

    @property
    def times(self) -> Array:
        """Times of the samples in s from the first, shape (n,)."""
        return read_only(samples_of(self.run)['time'])

    @property
    def stretches(self) -> Array:
        """Stretches, or deflections of a beam, shape (n,)."""
        return self.run.stretch

    @property
    def rates(self) -> Array:
        """Stretch rates in 1/s, shape (n,)."""
        return self.run.rate

    @property
    def flux_densities(self) -> Array:
        """Flux densities in T at the samples, NaN where unknown, shape (n,)."""
        return read_only(samples_of(self.run)['flux_density'])

    @property
    def levels(self) -> Array:
        """Times in s and flux densities in T of the levels, shape (m, 2)."""
        return read_only(np.column_stack(list(levels_of(self.run).values())))

    @property
    def actuator(self) -> 'Actuator':
        """The actuator, with the parameters that the record contains."""
        from hmsa.api.actuator import Actuator
        from hmsa.interfaces.actuator import parameters_of

        run = self.run
        return Actuator.from_parameters({
            **parameters_of(run.plant),
            'slew_limit': run.number('plant.slew_limit') or run.number('planner.slew_limit'),
            'coil_time_constant': run.coil_time_constant('plant') or (
                run.coil_time_constant('planner'))})

    def report(self, path: str | Path | None = None) -> Table:
        """
        Return the measured results of each setpoint or, without setpoints, of each level.

        With a path, also write the page of ``hmsa report`` there; raise `BadInputError` if it
        cannot be written.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> motion = Actuator().plan([(1.1, 0.2), (1.0, 0.2)]).simulate()
        >>> motion.report()['verdict']
        ['arrived', 'arrived']

        """
        from hmsa.report.comparison import Part, setpoints

        part = Part.of(self.run)
        if path is not None:
            from hmsa.files import write_text
            from hmsa.report.page import page

            write_text(file_of(path), page([part]))
        if part.evaluation.findings:
            return setpoints([part])
        from hmsa.report.evaluation import level_results, level_table

        return level_table(level_results(self.run))

    def plot(
            self, path: str | Path | Sequence[str | Path] | None = None, *, ax: Any = None,
            panel: Any = 'response', **more: Any) -> Any:
        """
        Draw command, response, phase plane and moves, as ``hmsa report --picture`` does.

        With ``ax``, draw one line into axes of your own, in seconds and tesla.

        Parameters
        ----------
        path : str, Path or sequence of these, optional
            Files to write; names end in .png, .pdf, .svg or .pgf.
        ax : matplotlib.axes.Axes, optional
            Axes to draw into, which keep their own labels, if any.
        panel : {'response', 'command', 'phase'}
            With ``ax``: stretch over time, flux density over time, or rate over stretch.
        **more
            ``width`` and ``height`` in mm, ``letters`` in pt, ``dpi``, ``panels``, and ``data``
            for a CSV file of the curves; see `hmsa.report.looks.Paper`. With ``ax``, properties
            of the line, such as ``color`` and ``label`` (default the name of the motion).

        Returns
        -------
        Figure or Axes
            The Matplotlib figure, which a notebook displays, or the given axes.

        Raises
        ------
        BadInputError
            If an argument is out of range, or a file cannot be written.

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> from hmsa import Actuator
        >>> block, ax = Actuator(), Figure().subplots()
        >>> for shaper in ('two_step', 'step'):
        ...     motion = block.plan([(1.1, 0.2)], shaper).simulate(label=shaper)
        ...     _ = motion.plot(ax=ax)
        >>> [x.get_label() for x in ax.get_lines()]
        ['two_step', 'step']

        """
        own = ax is not None
        if not own and isinstance(panel, str) and panel == 'response':
            return _draw([self.run], path, more)
        if path is not None or not own:
            raise BadInputError(
                f'plot has path {excerpt(path)}, ax {excerpt(ax)} and panel {excerpt(panel)}: '
                'expected files, or ax to draw into with a panel')
        return _draw_into(ax, self, panel, more)

    def save(self, path: str | Path) -> list[Path]:
        """
        Write the samples, and the levels to a second file, as ``hmsa export`` does.

        The name ends in .csv, .parquet or .mat. Raise `BadInputError` if a file cannot be written.

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from hmsa import Actuator
        >>> motion = Actuator().plan([(1.1, 0.2)]).simulate()
        >>> with TemporaryDirectory() as folder:
        ...     [x.name for x in motion.save(Path(folder, 'motion.csv'))]
        ['motion.csv', 'motion_levels.csv']

        """
        return write_run(file_of(path), self.run)

    def to_pandas(self) -> Any:
        """
        Return the samples as a DataFrame: time, stretch, stretch_rate and flux_density.

        Raise `BadInputError` if pandas is not installed.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> motion = Actuator().plan([(1.1, 0.2)]).simulate()
        >>> samples = motion.to_pandas().set_index('time')
        >>> samples.shape, round(float(samples['stretch'].iloc[-1]), 3)
        ((721, 3), 1.1)

        """
        return frame(samples_of(self.run))

    def to_xarray(self) -> Any:
        """
        Return the samples as an xarray Dataset over the time, with units as attributes.

        Raise `BadInputError` if xarray is not installed.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> samples = Actuator().plan([(1.1, 0.2)]).simulate().to_xarray()
        >>> samples['stretch'].dims, samples['time'].units
        (('time',), 's')
        >>> round(float(samples['stretch'].sel(time=0.15, method='nearest')), 3)
        1.1

        """
        return dataset(samples_of(self.run), UNITS)

    def __repr__(self) -> str:
        times = self.times
        return (f'<Motion {self.run.label}: {len(times)} samples in {times[-1]:.6g} s, '
                f'{len(self.levels)} levels>')

    def _repr_html_(self) -> str:
        return self.report()._repr_html_()


@suggesting
def read(path: str | Path, *, joint: str = '') -> Motion:
    """
    Read a bag without ROS.

    Parameters
    ----------
    path : str or Path
        Folder of a bag, or one of its files (MCAP, SQLite or ROS 1).
    joint : str
        Actuator to read, if the bag has several.

    Returns
    -------
    Motion
        Samples, levels and parameters.

    Raises
    ------
    BadInputError
        If there is no bag, it has no samples, or it has several actuators and ``joint`` is empty.

    Examples
    --------
    Read and draw the bag of ``hmsa run --out my_run``:

    >>> import hmsa
    >>> motion = hmsa.read('my_run/run')
    >>> figure = motion.plot('motion.pdf', width=85)

    """
    from hmsa.runs.bags import read_run

    if not isinstance(joint, str):
        raise BadInputError(f'joint is {excerpt(joint)}: expected a name')
    return Motion(read_run(file_of(path, 'the folder of a bag'), joint=joint))


@suggesting
def compare(
        *motions: Motion, picture: str | Path | Sequence[str | Path] | None = None,
        ax: Any = None, panel: str = 'response', **paper: Any) -> Table:
    """
    Compare motions: move time, steady-state error and vibration of each setpoint, and curves.

    Parameters
    ----------
    *motions : Motion
        Two or more; the others are compared with the first.
    picture : str, Path or sequence of these, optional
        Files to which to write a figure of all motions.
    ax : matplotlib.axes.Axes, optional
        Axes of your own to draw a line of each motion into.
    panel : {'response', 'command', 'phase'}
        With ``ax``, the curve to draw.
    **paper
        As for `Motion.plot`.

    Returns
    -------
    Table
        A row for each setpoint and motion.

    Raises
    ------
    BadInputError
        If there are fewer than two motions, or they have no setpoint.

    Examples
    --------
    >>> import hmsa
    >>> block = hmsa.Actuator()
    >>> runs = [block.plan([(1.1, 0.05)], shaper=x).simulate() for x in ('two_step', 'step')]
    >>> hmsa.compare(*runs)['apart'][1] > 50.0   # % of the step
    True
    >>> from matplotlib.figure import Figure
    >>> ax = Figure().subplots()
    >>> _ = hmsa.compare(*runs, ax=ax)
    >>> len(ax.get_lines())
    2

    """
    if len(motions) < 2 or not all(isinstance(x, Motion) for x in motions):
        raise BadInputError(
            f'got {excerpt(list(motions))} to compare: expected two motions or more, as read and '
            'simulate return them')
    from hmsa.report.comparison import comparison, Part

    found = comparison([Part.of(x.run) for x in motions])
    if picture is not None:
        _draw([x.run for x in motions], picture, {} if ax is not None else paper)
    elif paper and ax is None:
        raise BadInputError(
            f'{", ".join(paper)} given without a picture: expected picture, the file to draw, or '
            'ax' + ''.join(meant(x, ('picture', 'ax', 'panel')) for x in paper))
    if ax is not None:
        for each in motions:
            _draw_into(ax, each, panel, paper)
    return found


def _draw(runs: list[Run], path: Any, paper: Mapping[str, Any]) -> Any:
    """Draw runs in one set of axes; return the Matplotlib figure."""
    from hmsa.report.comparison import parts_of
    from hmsa.report.looks import Paper
    from hmsa.report.picture import draw

    paths = [] if path is None else [file_of(x) for x in several(path)]
    checked: dict[str, Any] = {
        x: y if x in ('data', 'panels') or y is None else number(y, x) for x, y in paper.items()}
    if isinstance(panels := checked.get('panels'), str):
        checked['panels'] = panels.split(',')
    known = [x.name for x in fields(Paper)]
    try:
        size = Paper(**checked)
    except TypeError as error:
        raise BadInputError(
            f'pictures have {", ".join(paper)}: expected numbers for width and height (mm), '
            'letters (pt) and dpi, names of panels, and data'
            + ''.join(meant(x, known) for x in paper if x not in known)) from error
    return draw(paths, parts_of(runs), size)


def _draw_into(ax: Any, motion: Motion, panel: Any, line: Mapping[str, Any]) -> Any:
    """Draw one curve of a motion into axes; return them."""
    from matplotlib.axes import Axes

    from hmsa.report.style import axis

    what = motion.run.plant.coordinate
    time = axis('time', 't', 's')
    position = axis(what.name, what.tex)
    panels = {
        'response': (time, position),
        'command': (time, axis('flux density', 'B', 'T')),
        'phase': (position, axis(f'{what.name} rate', rf'\dot{{{what.tex}}}', '1/s'))}
    if not isinstance(ax, Axes):
        raise BadInputError(f'ax is {excerpt(ax)}: expected axes of Matplotlib')
    check_choice('panel', panel, panels)
    line = {'label': motion.run.label, **line}
    try:
        if panel == 'command':
            switches, values = motion.levels.T
            end = motion.times[-1:]
            ax.step(np.append(switches, end), np.append(values, values[-1:]), where='post', **line)
        elif panel == 'phase':
            ax.plot(motion.stretches, motion.rates, **line)
        else:
            ax.plot(motion.times, motion.stretches, **line)
    except (AttributeError, TypeError, ValueError) as error:
        raise BadInputError(
            f'{", ".join(line)} cannot be drawn: {error}; expected properties of a line of '
            'Matplotlib') from error
    x_label, y_label = panels[panel]
    ax.set_xlabel(ax.get_xlabel() or x_label)
    ax.set_ylabel(ax.get_ylabel() or y_label)
    return ax


def simulated(
        truth: 'Actuator', times: Array, levels: Array, start: float | None,
        plan: 'Plan | None' = None, *, until: float | None, rate: float | None, noise: float,
        seed: int, label: str) -> Motion:
    """
    Simulate levels in T at times in s; a plan adds its setpoints and predictions to the record.

    The start is a stretch at rest, by default that without a field; the other arguments are
    those of `Actuator.simulate`. Raise `BadInputError` for unusable arguments, `HmsaError` for
    levels that cannot be simulated.
    """
    model, units = truth.model, truth.model.units
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back) or times[0] < 0.0 or not np.all(np.isfinite(times) & np.isfinite(levels)):
        place = int(back[0]) + 1 if len(back) else 0
        raise BadInputError(
            f'levels have the time {times[place]:g} s and the flux density '
            f'{levels[place]:g} T in row {place + 1}: expected finite numbers, and increasing '
            'times from 0 s on')
    low, high = truth.flux_density_limits
    beyond = np.flatnonzero((levels < low) | (levels > high))
    if plan is None and len(beyond):
        raise BadInputError(
            f'level {levels[beyond[0]]:g} T in row {int(beyond[0]) + 1} is beyond the limits '
            f'of the coil, {low:g} to {high:g} T: expected flux densities in T, or '
            'flux_density_limits (in a parameter file flux_density_max) that allow it')
    begin = number(model.material.rest if start is None else start, 'start')
    model.material.check(begin, 'start stretch')
    if until is not None:
        end = number(until, 'until', 's', above=0.0)
    elif plan is None or math.isinf(end := float(np.sum(plan.setpoints[:, 1]))):
        left = longest_motion(units.of_level(float(levels[-1])), model.material)
        end = float(times[-1]) + units.time * (left + model.delivery.settling(0.0))
    hertz = _rate(truth.block.period) if rate is None else number(
        rate, 'rate', 'Hz', above=0.0, most=1e9)
    if end * hertz > _MOST_SAMPLES:
        raise BadInputError(
            f'{end:g} s at {hertz:g} Hz are {end * hertz:.3g} samples: expected at most '
            f'{_MOST_SAMPLES}; give a lower rate or an earlier end (until)')
    noise = number(noise, 'noise', least=0.0)
    stamps = np.round(np.arange(int(end * hertz * (1.0 + 1e-12)) + 1) / hertz * NANOSECONDS
                      ).astype(np.int64)
    stretch, speed, field = response(
        truth.block, model.delivery, times, levels, stamps / NANOSECONDS, begin)
    switched = np.round(times * NANOSECONDS).astype(np.int64).tolist()
    stretch = stretch + noise * np.random.default_rng(
        whole(seed, 'seed', least=0)).standard_normal(len(stretch))
    commands = tuple(
        RecordedLevel(stamp, level, -_AHEAD) for stamp, level in zip(
            switched, levels.tolist(), strict=True))
    asked: tuple[Outcome, ...] = ()
    planned: tuple[RecordedLevel, ...] = ()
    believed = truth if plan is None else plan.actuator
    if plan is not None:
        asked = _outcomes(plan, begin)
        predicted = response(
            believed.block, believed.model.delivery, times, levels, times, begin)
        planned = tuple(
            RecordedLevel(stamp, level, -_AHEAD, x, y) for stamp, level, x, y in zip(
                switched, levels.tolist(), *(z.tolist() for z in predicted[:2]), strict=True))
    parameters = {
        f'{node}.{name}': value for node, each in (('planner', believed), ('plant', truth))
        for name, value in each.parameters.items()} | {'plant.stretch_noise': noise}
    return Motion(Run(
        str(label), '', Path(str(label)), stamps, stamps, stretch, speed, field,
        commands, commands, plans=(planned,) if planned else (), outcomes=asked,
        parameters=parameters, plant=truth.block, planner=believed.block, parameters_known=True,
        origin='simulated'))


def _outcomes(plan: 'Plan', start: float) -> tuple[Outcome, ...]:
    """Return the setpoints of a plan from a stretch on, to be judged by the simulated samples."""
    found, begins, count = [], 0, len(plan.segments)
    ends = np.cumsum(plan.setpoints[:, 1])
    for i, (segment, duration, end) in enumerate(zip(
            plan.segments, plan.move_times.tolist(), ends.tolist(), strict=True), 1):
        target, until = segment.setpoint.stretch, (
            round(end * NANOSECONDS) if math.isfinite(end) else None)
        found.append(Outcome(setpoint=replace(
            described(plan.actuator.block, target, start, begins, until), number=i, count=count,
            held=i == count, arrival=begins + round(duration * NANOSECONDS)
            if math.isfinite(duration) else None)))
        begins, start = until or begins, target
    return tuple(found)


def _rate(period: float) -> float:
    """Return the default sampling rate in Hz, a round number, for a natural period in s."""
    wanted = max(_RATE, _A_PERIOD / period)
    digits = 10 ** (math.floor(math.log10(wanted)) - 1)
    return float(math.ceil(wanted / digits) * digits)
