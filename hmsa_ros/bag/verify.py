"""
Checking a recorded run against the model: the recorded commands, integrated once more.

Parameters are taken from the bag, the state from its first sample; from there on every sample
of the stretch must come out again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
import json
import math
import os
from typing import Any

from hmsa_ros.bag.reader import BagReader
from hmsa_ros.errors import BadInputError

COMMAND = 'flux_density_command'
STATES = 'joint_states'
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Verification:
    """
    Recorded against integrated motion.

    Attributes
    ----------
    states, commands : str
        The topics compared.
    sample_count, command_count : int
        Messages compared and applied.
    late_count : int
        Commands that came after their stamp, so that the moment of their effect is not known.
    largest_difference : float
        Of the stretch, dimensionless.
    where : float
        Time of it after the first sample, in seconds.

    """

    states: str
    commands: str
    sample_count: int
    command_count: int
    late_count: int
    largest_difference: float
    where: float


def verify(path: str | os.PathLike[str]) -> list[Verification]:
    """
    Integrate the recorded commands and compare with the recorded stretch.

    Parameters
    ----------
    path : path
        Folder of a bag, or one ``.mcap`` file.

    Returns
    -------
    list of Verification
        One for each actuator in the bag.

    Raises
    ------
    BadInputError
        If the bag has no commands with the response to them, or does not tell the actuator's
        parameters.
    HmsaError
        If the integration does not get through.

    """
    reader = BagReader(path)
    pairs = [(name, _beside(name, COMMAND)) for name in reader.topics
             if name.rsplit('/', 1)[-1] == STATES and _beside(name, COMMAND) in reader.topics]
    if not pairs:
        raise BadInputError(
            f'{path} holds no pair of topics {STATES} and {COMMAND}: expected a recorded run of '
            'the plant; it has ' + (', '.join(reader.topics) or 'no topics'))
    return [_verify(reader, states, commands) for states, commands in pairs]


def _beside(topic: str, name: str) -> str:
    """Return the topic of another name in the same namespace."""
    return topic[:topic.rindex('/') + 1] + name


def _stamp(message: Any) -> int:
    """Return a message's stamp in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def _verify(reader: BagReader, states: str, commands: str) -> Verification:
    """Compare one actuator."""
    from hmsa_ros.core.simulation import ActuatorSimulation
    simulation: ActuatorSimulation | None = None
    decode_state, decode_command = reader.decoder(states), reader.decoder(commands)
    ahead: list[tuple[int, float]] = []
    samples = applied = late = 0
    largest, where, first = 0.0, 0, 0
    for message in reader.messages((states, commands)):
        if message.topic == commands:
            command = decode_command(message.data)
            stamp, flux_density = _stamp(command), float(command.magnetic_field.z)
            applied += 1
            if simulation is None:
                ahead.append((stamp, flux_density))
            else:
                late += simulation.command(stamp or simulation.time, flux_density) > 0
            continue
        sample = decode_state(message.data)
        stamp, stretch = _stamp(sample), float(sample.position[0])
        samples += 1
        if simulation is None:
            first = stamp
            simulation = _start(reader.custom_data, stamp)
            simulation.set_state(stretch, float(sample.velocity[0]), float(sample.effort[0]))
            for command_stamp, flux_density in ahead:
                # What had taken effect by the first sample is in force with it.
                if command_stamp > stamp:
                    simulation.command(command_stamp, flux_density)
            continue
        simulation.advance(stamp)
        difference = abs(simulation.stretch - stretch)
        if difference > largest or math.isnan(difference):
            largest, where = difference, stamp - first
    if simulation is None:
        raise BadInputError(f'topic {states} of {reader.path} has no message: expected samples '
                            'of the stretch')
    return Verification(states, commands, samples, applied, late, largest, where * 1e-9)


def _start(custom_data: Mapping[str, str], time: int) -> Any:
    """Return the simulation of the recorded actuator."""
    from hmsa_ros.core.parameters import ActuatorParameters
    from hmsa_ros.core.simulation import ActuatorSimulation
    values = {}
    for field in fields(ActuatorParameters):
        if not field.init:
            continue
        key = f'plant.actuator.{field.name}'
        try:
            values[field.name] = float(json.loads(custom_data[key]))
        except (KeyError, TypeError, ValueError):
            raise BadInputError(
                f'the bag does not tell parameter {key}: expected a bag recorded while the '
                'plant was running') from None
    slew_limit = float(json.loads(custom_data.get('plant.slew_limit', '0')))
    return ActuatorSimulation(
        ActuatorParameters(**values), time=time, slew_limit=slew_limit or math.inf)
