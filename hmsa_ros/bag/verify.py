"""
Checking a recorded run against the model: the recorded commands, integrated once more.

Parameters are taken from the bag, the state from its first sample; from there on every sample
of the stretch must come out again. One bag may hold plants in several namespaces, and each of
them several joints.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
import json
import math
import os
from typing import Any

from hmsa_ros.bag import limits
from hmsa_ros.bag.experiment import parameters_of
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


@dataclass(frozen=True)
class _Pair:
    """Where to find an actuator: its topics, and its joint, empty for the first."""

    states: str
    commands: str
    joint: str

    @property
    def space(self) -> str:
        """Return the namespace."""
        return self.states[:self.states.rindex('/')]


def verify(
        path: str | os.PathLike[str], *,
        max_chunk_size: int = limits.CHUNK_SIZE) -> list[Verification]:
    """
    Integrate the recorded commands and compare with the recorded stretch.

    Parameters
    ----------
    path : path
        Folder of a bag, or one ``.mcap`` file.
    max_chunk_size : int
        As for `BagReader`.

    Returns
    -------
    list of Verification
        One for each actuator in the bag.

    Raises
    ------
    BadInputError
        If the bag has no commands with the response to them, does not tell the actuator's
        parameters, or holds several runs after each other.
    HmsaError
        If the integration does not get through.

    """
    reader = BagReader(path, max_chunk_size=max_chunk_size)
    jumps = reader.custom_data.get('time_jumps', '0')
    if jumps != '0' and len(reader.files) > 1:
        raise BadInputError(
            f'in {path} time jumped back {jumps} times: expected one run; name one of its files, '
            f'for example {reader.files[0]}')
    pairs = _pairs(reader)
    if not pairs:
        raise BadInputError(
            f'{path} holds no pair of topics {STATES} and {COMMAND}: expected a recorded run of '
            'the plant; it has ' + (', '.join(reader.topics) or 'no topics'))
    return [_verify(reader, pair) for pair in pairs]


def _pairs(reader: BagReader) -> list[_Pair]:
    """Return the actuators with joint states and commands."""
    pairs = []
    for states in reader.topics:
        space, slash, name = states.rpartition('/')
        if name != STATES or not slash:
            continue
        if f'{space}/{COMMAND}' in reader.topics:
            pairs.append(_Pair(states, f'{space}/{COMMAND}', ''))
            continue
        # A plant of several joints has their commands one level deeper.
        for topic in reader.topics:
            above, _, last = topic.rpartition('/')
            if last == COMMAND and above.rpartition('/')[0] == space:
                pairs.append(_Pair(states, topic, above.rpartition('/')[2]))
    return pairs


def _stamp(message: Any) -> int:
    """Return a message's stamp in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def _command(pair: _Pair, command: Any) -> tuple[int, float]:
    """Return stamp and flux density of a command."""
    try:
        return _stamp(command), float(command.magnetic_field.z)
    except (AttributeError, TypeError, ValueError):
        raise BadInputError(
            f'a message of {pair.commands} is no command: expected sensor_msgs/msg/'
            'MagneticField') from None


def _verify(reader: BagReader, pair: _Pair) -> Verification:
    """Compare one actuator."""
    from hmsa_ros.core.simulation import ActuatorSimulation
    simulation: ActuatorSimulation | None = None
    states, commands = pair.states, pair.commands
    decode_state, decode_command = reader.decoder(states), reader.decoder(commands)
    ahead: list[tuple[int, float]] = []
    samples = applied = late = 0
    largest, where, first = 0.0, 0, 0
    for message in reader.messages((states, commands)):
        if message.topic == commands:
            stamp, flux_density = _command(pair, decode_command(message.data))
            applied += 1
            if simulation is None:
                ahead.append((stamp, flux_density))
            else:
                late += simulation.command(stamp or simulation.time, flux_density) > 0
            continue
        stamp, stretch, rate, effort = _sample(pair, decode_state(message.data))
        samples += 1
        if simulation is None:
            first = stamp
            simulation = _start(reader.custom_data, pair, stamp)
            simulation.set_state(stretch, rate, effort)
            for command_stamp, command_level in ahead:
                # What had taken effect by the first sample is in force with it.
                if command_stamp > stamp:
                    simulation.command(command_stamp, command_level)
            continue
        simulation.advance(stamp)
        difference = abs(simulation.stretch - stretch)
        if difference > largest or math.isnan(difference):
            largest, where = difference, stamp - first
    if simulation is None:
        raise BadInputError(f'topic {states} of {reader.path} has no message: expected samples '
                            'of the stretch')
    return Verification(states, commands, samples, applied, late, largest, where * 1e-9)


def _sample(pair: _Pair, sample: Any) -> tuple[int, float, float, float]:
    """Return stamp, stretch, rate and flux density of the joint."""
    try:
        i = list(sample.name).index(pair.joint) if pair.joint else 0
        return (_stamp(sample), float(sample.position[i]), float(sample.velocity[i]),
                float(sample.effort[i]))
    except (AttributeError, IndexError, TypeError, ValueError):
        raise BadInputError(
            f'a message of {pair.states} has no position, velocity and effort of '
            f'{pair.joint or "a joint"}: expected the samples of a plant') from None


def _only_joint(texts: Mapping[str, str]) -> str:
    """Return the joint of a plant that has one, as far as its parameters name it."""
    try:
        names = json.loads(texts.get('joints', '[]'))
        return str(names[0]) if isinstance(names, list) and names else ''
    except ValueError:
        return ''


def _start(custom_data: Mapping[str, str], pair: _Pair, time: int) -> Any:
    """Return the simulation of the recorded actuator."""
    from hmsa_ros.core.parameters import ActuatorParameters
    from hmsa_ros.core.simulation import ActuatorSimulation
    texts = parameters_of(custom_data, 'plant', pair.space)

    joint = pair.joint or _only_joint(texts)

    def number(name: str) -> float:
        # What is set for a joint goes before what is set for all.
        own = texts.get(f'{joint}.{name}', 'null')
        try:
            return float(json.loads(texts.get(name, '') if own == 'null' else own))
        except (TypeError, ValueError):
            raise BadInputError(
                f'the bag does not tell parameter {name} of node {pair.space}/plant: expected a '
                'bag recorded while the plant was running') from None

    values = {field.name: number(f'actuator.{field.name}')
              for field in fields(ActuatorParameters) if field.init}
    slew_limit = number('slew_limit') if 'slew_limit' in texts else 0.0
    return ActuatorSimulation(
        ActuatorParameters(**values), time=time, slew_limit=slew_limit or math.inf)
