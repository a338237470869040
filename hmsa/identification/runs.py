"""Recordings from bags."""

import math
from pathlib import Path

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification.measurement import Measurement
from hmsa.interfaces.topics import PLANNER
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.runs.bags import read_run
from hmsa.runs.record import in_force, Run, without_repeats


def read_bag(
        path: Path, *, joint: str = '', actuator: ActuatorParameters | None = None
) -> tuple[Measurement, ActuatorParameters, dict[str, float]]:
    """
    Read the recording of one actuator from a bag: a folder, or an ``.mcap`` file.

    Return the recording, with times from the first sample on, the given or planned actuator, and
    the planner's parameters of the coil. Raise `BadInputError` if there is no bag, or several
    actuators and ``joint`` is empty.
    """
    return recording_of(read_run(path, joint=joint), actuator)


def recording_of(
        run: Run, actuator: ActuatorParameters | None = None
) -> tuple[Measurement, ActuatorParameters, dict[str, float]]:
    """Return the recording of a run, as `read_bag`; raise `BadInputError` if it has no level."""
    block = run.planner if actuator is None else actuator if math.isnan(run.temperature) else (
        actuator.at_temperature(run.temperature))
    # A recorder receives earlier latched changes after the first new one.
    levels = run.reported or in_force((x,) for x in without_repeats(run.accepted)[0])
    if not levels:
        raise BadInputError(
            f'{run.path} has no command that took effect: expected the levels of the field')
    zero = int(run.time[0])
    stamps = np.array([(x.stamp - zero) / NANOSECONDS for x in levels])
    fields = np.array([x.flux_density for x in levels])
    if stamps[0] > 0.0:
        # Before the first command use the field of the first sample, if known.
        field = float(run.flux_density[0])
        stamps = np.append(0.0, stamps)
        fields = np.append(field if math.isfinite(field) else 0.0, fields)
    slew = run.number('planner.slew_limit') or run.number('plant.slew_limit')
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(stamps) > 0.0, True)
    notes = () if actuator is not None else tuple(
        x.rstrip('.') for x in run.notes if 'unshaped steps' not in x)
    if actuator is None and not run.parameters_known:
        notes += (
            "the recording does not contain the actuator's parameters: what is not identified is "
            'that of the example block; name a parameter file (--params-file)',)
    return (
        Measurement(
            (run.time - zero) / NANOSECONDS, run.stretch, stamps[keep], fields[keep],
            slew or math.inf, 0.0, run.label, notes, block.coordinate,
            temperature=run.temperature),
        block,
        {'coil_time_constant': run.coil_time_constant(PLANNER)})
