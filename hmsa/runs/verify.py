"""
Check of a run against the model: its commands, simulated again.

The simulation starts from the state of the first sample and must reproduce all later samples of
the stretch. If the plant reported which levels took effect and when, these are used, so that late,
refused and repeated commands and the watchdog are accounted for. Recorded disturbing forces and
temperatures are applied, and viscoelastic branches are simulated. Measurement noise is not: it
remains as a difference.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import heapq
import itertools
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hmsa.errors import BadInputError
from hmsa.interfaces.parameters import number_of
from hmsa.interfaces.topics import PLANT
from hmsa.model.creep import Creep
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa.runs.bags import CLOCK_JUMP, read_runs
from hmsa.runs.parameters import creep_of, of_joint
from hmsa.runs.record import (
    in_force,
    lateness_of,
    RecordedLevel,
    ROUNDED_STAMP,
    Run,
    without_repeats,
)
from hmsa.runs.topics import APPLIED, COMMAND, FORCE, JOINT_STATES

if TYPE_CHECKING:
    # Not needed by other commands on bags.
    from hmsa.model.simulation import ActuatorSimulation

# Distance in time from other samples, in ns, above which samples belong to another run.
_LARGEST_LEAP = 3600 * NANOSECONDS
_COMMAND, _FORCE, _TEMPERATURE, _SAMPLE = range(4)
# Largest error of a sample, in standard deviations of its noise: one in 10^9.
_SIGMAS = 6.0
# Minimum distance from rest, in stretch, for branches to have an overstress.
_AT_REST = 1e-6


@dataclass(frozen=True)
class Verification:
    """Recorded and simulated motion compared."""

    states: str  # the topics compared
    commands: str
    sample_count: int  # messages compared
    command_count: int  # commands applied in the simulation
    # Commands that took effect after their timestamp, or that were received after it, where
    # nothing reported the time of their effect.
    late_count: int
    largest_difference: float  # of the stretch, or of a beam's deflection; dimensionless
    where: float  # its time after the first sample, in s
    note: str = ''  # losses, noise, skipped messages
    left_out: int = 0  # messages that do not fit their topic
    unapplied_count: int = 0  # changes of level reported as never in effect
    # Changes of level that came later than plant or driver accept, and were rejected.
    rejected_count: int = 0


def verify(path: str | os.PathLike[str]) -> list[Verification]:
    """Compare each actuator of a bag with its recorded stretch: `read_runs`, then `verify_run`."""
    return [verify_run(run) for run in read_runs(Path(path))]


def verify_run(run: Run) -> Verification:
    """
    Simulate the levels of one actuator and compare the result with its samples.

    Raise `BadInputError` if there are no commands and no field, the parameters of the actuator are
    unknown, or there are several runs; `HmsaError` if the simulation fails.
    """
    if run.summary is not None and len(run.summary.files) > 1 and (
            jumps := run.summary.custom_data.get('time_jumps', '0')) != '0':
        raise BadInputError(
            f'in {run.path} time jumped back {jumps} times: expected one run; name one of its '
            f'files, for example {run.path / run.summary.files[0][0]}')
    if COMMAND not in run.topics and not run.levels:
        raise BadInputError(
            f'{run.path} contains no {COMMAND} and no field: expected a run with the commands of '
            'the actuator; its topics are ' + (', '.join(run.topics.values()) or 'none'))
    if not run.parameters_known:
        raise BadInputError(
            f'{run.path} does not contain the parameters of the plant: name a parameter file '
            'with --params-file')
    window = _one_run(run)
    if back := _set_back(run, window):
        raise BadInputError(
            f'the timestamps of the samples in {run.path} jump back by '
            f'{back / NANOSECONDS:.3f} s, '
            'as if the clock of the plant or driver had been set: expected increasing times; '
            'record a '
            'run whose clock is not set')
    begin = int(run.time[window.start])
    notes: list[str] = []
    creep = creep_of(run.parameters, run.joint)
    simulation = _start(run, window.start, creep)
    if creep and not _rests(simulation):
        notes.append(
            'the first sample is not at rest: the overstress of the viscoelastic branches is '
            'unknown there and taken as 0, expected differences that fade')
    samples = zip(
        np.maximum.accumulate(run.logged[window]).tolist(), itertools.repeat(_SAMPLE),
        run.time[window].tolist(), run.stretch[window].tolist(), strict=False)
    forces = ((sent, _FORCE, stamp, newton) for sent, stamp, newton in run.forces)
    warm = ((sent, _TEMPERATURE, stamp, celsius) for sent, stamp, celsius in run.temperatures)
    count = window.stop - window.start
    late = refused = 0
    left_out = run.left_out + len(run.time) - count
    largest, where = 0.0, 0
    for _, kind, stamp, value in heapq.merge(
            samples, _commands(run, window.start), forces, warm, key=lambda x: x[:2]):
        if kind == _SAMPLE:
            simulation.advance(stamp)
            difference = abs(simulation.stretch - value)
            if difference > largest or math.isnan(difference):
                largest, where = difference, stamp - begin
            continue
        try:
            if kind == _TEMPERATURE:
                simulation.set_temperature(value)
            elif kind == _FORCE:
                simulation.force(stamp, value)
            elif simulation.command(stamp, value) > 0 and not run.applied:
                late += 1
        except BadInputError:
            left_out += 1
            refused += kind == _COMMAND
    lateness, unapplied = _lateness(run)
    late += int(np.count_nonzero(lateness * NANOSECONDS > ROUNDED_STAMP))
    return Verification(
        run.topics.get(JOINT_STATES, str(run.path)), run.topics.get(COMMAND, ''), count,
        len(run.accepted) - refused, late, largest, where / NANOSECONDS,
        '; '.join([*notes, *_notes(run, left_out, unapplied, largest)]), left_out, unapplied,
        run.rejected)


def _commands(run: Run, first: int) -> Iterator[tuple[int, int, int, float]]:
    """Yield the levels that took effect, known from the start; or else the commands."""
    begin, logged = int(run.time[first]), int(run.logged[first])
    if run.applied or not run.commands:
        for level in run.levels:
            if level.stamp > begin:
                yield logged - 1, _COMMAND, level.stamp, level.flux_density
        return
    for level in run.accepted:
        if level.sent > logged or level.stamp > begin:
            yield level.sent, _COMMAND, level.stamp, level.flux_density


def _one_run(run: Run) -> slice:
    """Return the samples without a leap in time; the longest part if there are several."""
    ends = [0, *(np.flatnonzero(np.diff(run.time) > _LARGEST_LEAP) + 1).tolist(), len(run.time)]
    return max((slice(*x) for x in zip(ends, ends[1:], strict=False)),
               key=lambda x: x.stop - x.start)


def _set_back(run: Run, window: slice) -> int:
    """Return the ns by which timestamps jump back, in the order of the recording; 0 for none."""
    order = np.argsort(run.logged[window], kind='stable')
    stamps = run.time[window][order]
    back = int((np.maximum.accumulate(stamps) - stamps).max())
    return back if back > CLOCK_JUMP else 0


def _start(run: Run, first: int, creep: Creep) -> 'ActuatorSimulation':
    """Return the simulation of the recorded actuator in the state of its first sample."""
    from hmsa.model.equations import elastic_force
    from hmsa.model.simulation import ActuatorSimulation

    stamp = int(run.time[first])
    simulation = ActuatorSimulation(
        run.plant, time=stamp, slew_limit=run.number('plant.slew_limit') or math.inf,
        coil_time_constant=run.coil_time_constant(PLANT),
        creep=creep)
    if run.temperatures:
        simulation.set_temperature(run.temperatures[0][2])
    # Levels applied by then count; the field of a slow coil may not have settled yet.
    past = [x.flux_density for x in sorted(run.applied, key=lambda x: x.stamp)
            if x.stamp <= stamp]
    field = float(run.flux_density[first])
    if math.isnan(field):
        before = [x.flux_density for x in run.levels if x.stamp <= stamp]
        # Otherwise use the holding level: it may have been applied before the recording.
        field = before[-1] if before else float(run.plant.units.level(
            elastic_force(float(run.stretch[first]), run.plant.nondimensional)))
    try:
        simulation.set_state(
            float(run.stretch[first]), float(run.rate[first]), field, past[-1] if past else None)
    except BadInputError as error:
        raise BadInputError(
            f'the first sample of {run.path} is not of the actuator that the parameters describe: '
            f'{error}; name the parameter file of the recorded one with --params-file') from error
    return simulation


def _rests(simulation: 'ActuatorSimulation') -> bool:
    """Return whether an actuator is at equilibrium and at rest."""
    return abs(simulation.equilibrium() - simulation.stretch) < _AT_REST and (
        abs(simulation.rate) * simulation.actuator.time_unit < _AT_REST)


def _lateness(run: Run) -> tuple[Array, int]:
    """
    Return the lateness of commands in s, and how many due changes of level had no effect.

    Both are according to the plant or driver; the first is empty if that did not report.
    """
    none = np.empty(0)
    if APPLIED not in run.topics:
        return none, 0
    commands, last = without_repeats(run.accepted)[0], int(run.time[-1])
    # The initial level may be sent again without a change.
    known = run.applied
    if math.isfinite(field := float(run.flux_density[0])):
        known = RecordedLevel(int(run.time[0]), field, int(run.logged[0])), *known
    if not known:
        return none, sum(x.stamp < last for x in in_force((x,) for x in commands))
    return lateness_of(commands, known, last)


def _notes(run: Run, left_out: int, unapplied: int, largest: float) -> Iterator[str]:
    """Yield reasons for differences between samples and motion, and lost messages."""
    lost = run.lost(COMMAND, APPLIED, FORCE)
    if lost:
        yield (f'the recorder lost messages, {" and ".join(lost)}: expected differences from '
               'there on')
    # Each with its value for an ideal sensor, and the difference of stretch per unit.
    noise = [
        (f'{name} {value:g}', abs(value - ideal) * size) for name, ideal, size in (
            ('stretch_noise', 0.0, _SIGMAS),
            ('rate_noise', 0.0, _SIGMAS * run.plant.time_unit),
            ('stretch_bias', 0.0, 1.0), ('stretch_gain', 1.0, float(np.abs(run.stretch).max())))
        if (value := number_of(of_joint(run.parameters, run.joint, f'plant.{name}')))
        not in (None, ideal)]
    if noise:
        # The simulation begins with the error of the first sample.
        explained = 2.0 * sum(x for _, x in noise)
        yield (f'the samples are measured with {" and ".join(x for x, _ in noise)}: expected '
               + ('differences of that size, from the first sample on' if largest <= explained else
                  f'at most {explained:.2g} from that; the rest is from parameters or commands '
                  'other than the real ones'))
    if run.rejected:
        yield (f'{run.rejected} commands came later than lateness_limit and were rejected; what '
               'was sent anew is compared')
    if unapplied:
        yield (f'{unapplied} commands never took effect, as {run.topics[APPLIED]} shows: '
               'no node applied them')
    if left_out:
        yield f'left out: {left_out} of the messages, since they do not fit their topic'
