"""
Checking a recorded run against the model: the recorded commands, integrated once more.

Parameters are taken from the bag, the state from its first sample; from there on every sample
of the stretch must come out again. Where the plant has told which levels took effect and when,
these are integrated, so that late, refused and repeated commands and its watchdog are accounted
for; recorded disturbing forces are applied too. Measurement noise is not: it is the difference
that is left. One bag may hold plants in several namespaces, and each of
them several joints. Messages that are not what their topic is for are left out, and counted.
"""

from bisect import insort
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
import json
import math
import os
from typing import Any, TYPE_CHECKING

from hmsa_ros.bag import limits
from hmsa_ros.bag.experiment import parameters_of
from hmsa_ros.bag.info import lost_messages
from hmsa_ros.bag.reader import BagReader
from hmsa_ros.core.schedule import obeyed
from hmsa_ros.errors import BadInputError, BagError, HmsaError

if TYPE_CHECKING:
    # Numba comes along with it, which other commands on bags have no use for.
    from hmsa_ros.core.simulation import ActuatorSimulation

COMMAND = 'flux_density_command'
APPLIED = 'flux_density_applied'
FORCE = 'disturbance_force'
STATES = 'joint_states'
_NANOSECONDS = 1_000_000_000
# Samples further from the last one than this are of another run, or garbage; in ns.
_LARGEST_LEAP = 3600 * _NANOSECONDS


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
        Commands that came after their stamp, so that the moment of their effect is not known;
        none where the plant has told it.
    largest_difference : float
        Of the stretch, dimensionless.
    where : float
        Time of it after the first sample, in seconds.
    note : str
        Why the motion cannot come out exactly, empty if it must.
    left_out : int
        Messages that could not be used, since they are not what their topic is for.

    """

    states: str
    commands: str
    sample_count: int
    command_count: int
    late_count: int
    largest_difference: float
    where: float
    note: str = ''
    left_out: int = 0


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

    def beside(self, name: str) -> str:
        """Return a topic that stands beside the commands."""
        return self.commands[:self.commands.rindex('/') + 1] + name


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
    """Return stamp and flux density of a command that a plant would obey."""
    try:
        field = command.magnetic_field
        stamp, x, y, z = _stamp(command), float(field.x), float(field.y), float(field.z)
    except (AttributeError, TypeError, ValueError):
        raise BadInputError(
            f'a message of {pair.commands} is no command: expected sensor_msgs/msg/'
            'MagneticField') from None
    if not obeyed(x, y, z):
        raise BadInputError(
            f'a message of {pair.commands} is ({x:g}, {y:g}, {z:g}) T: expected a finite field '
            'along z')
    return stamp, z


class _Replay:
    """An actuator that is driven anew by what was recorded of it."""

    def __init__(self, pair: _Pair, custom_data: Mapping[str, str]) -> None:
        self._pair = pair
        self._custom_data = custom_data
        self._simulation: ActuatorSimulation | None = None
        # What takes effect, by stamp, and what is known before the first sample.
        self._applied: list[tuple[int, float]] = []
        self._ahead: list[tuple[int, float]] = []
        self._forces: list[tuple[int, float]] = []
        self._first = 0
        self.samples = self.commands = self.late = 0
        self.largest, self.where = 0.0, 0
        # By topic, how many messages were left out, and why the first of them.
        self.left_out: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def leave_out(self, topic: str, error: HmsaError) -> None:
        """Count a message that cannot be used."""
        self.left_out[topic] += 1
        self.reasons.setdefault(topic, str(error))

    def applied(self, message: Any) -> None:
        """Take what took effect; all of it is known before the rest is taken."""
        insort(self._applied, _command(self._pair, message), key=lambda x: x[0])

    def command(self, message: Any) -> None:
        """Take a command, which counts where nobody told what took effect."""
        stamp, flux_density = _command(self._pair, message)
        if self._applied:
            self.commands += 1
        elif self._simulation is None:
            self._ahead.append((stamp, flux_density))
        else:
            self.late += self._simulation.command(
                stamp or self._simulation.time, flux_density) > 0
            self.commands += 1

    def force(self, message: Any) -> None:
        """Take a disturbing force."""
        stamp, newton = _force(self._pair.beside(FORCE), message)
        if self._simulation is None:
            self._forces.append((stamp, newton))
        else:
            self._simulation.force(stamp or self._simulation.time, newton)

    def sample(self, message: Any) -> None:
        """
        Take a sample: begin with it, or hold it against the motion so far.

        Parameters
        ----------
        message : object
            As decoded.

        Raises
        ------
        BadInputError
            If it is no sample of the joint, or of another time.

        """
        stamp, stretch, rate, effort = _sample(self._pair, message)
        if self._simulation is None:
            self._simulation = self._begun(stamp, stretch, rate, effort)
            self._first = stamp
        else:
            leap = stamp - self._simulation.time
            if abs(leap) > _LARGEST_LEAP:
                raise BadInputError(
                    f'a message of {self._pair.states} is stamped {leap / _NANOSECONDS:+g} s '
                    'from the one before it: expected one run')
            self._simulation.advance(stamp)
            difference = abs(self._simulation.stretch - stretch)
            if difference > self.largest or math.isnan(difference):
                self.largest, self.where = difference, stamp - self._first
        self.samples += 1

    def _begun(self, stamp: int, stretch: float, rate: float, effort: float) -> Any:
        """Return the simulation as it is at the first sample."""
        simulation = _start(self._custom_data, self._pair, stamp)
        # What had taken effect by then is in force; a slow coil may still be on its way there.
        past = [level for at, level in self._applied if at <= stamp]
        simulation.set_state(stretch, rate, effort, past[-1] if past else None)
        for at, level in self._applied or self._ahead:
            try:
                if at > stamp:
                    simulation.command(at, level)
                self.commands += not self._applied
            except BadInputError as error:
                self.leave_out(self._pair.commands, error)
        for at, newton in self._forces:
            try:
                simulation.force(at, newton)
            except BadInputError as error:
                self.leave_out(self._pair.beside(FORCE), error)
        return simulation


def _verify(reader: BagReader, pair: _Pair) -> Verification:
    """Compare one actuator."""
    replay = _Replay(pair, reader.custom_data)

    def take(handlers: Mapping[str, Callable[[Any], None]]) -> None:
        decoders = {x: reader.decoder(x) for x in handlers if x in reader.topics}
        for message in reader.messages(tuple(decoders)):
            try:
                handlers[message.topic](decoders[message.topic](message.data))
            except (BagError, BadInputError) as error:
                replay.leave_out(message.topic, error)

    take({pair.beside(APPLIED): replay.applied})
    take({pair.states: replay.sample, pair.commands: replay.command,
          pair.beside(FORCE): replay.force})
    # A few that are not what they should be do not spoil the rest.
    if replay.left_out[pair.states] > replay.samples:
        raise BadInputError(replay.reasons[pair.states])
    if replay.left_out[pair.commands] and not replay.commands:
        raise BadInputError(replay.reasons[pair.commands])
    if not replay.samples:
        raise BadInputError(f'topic {pair.states} of {reader.path} has no message: expected '
                            'samples of the stretch')
    left_out = replay.left_out.total()
    notes = [_note(reader.custom_data, pair)]
    if left_out:
        notes.append(f'left out: {left_out} of the messages, for example since '
                     f'{next(iter(replay.reasons.values()))}')
    return Verification(
        pair.states, pair.commands, replay.samples, replay.commands, replay.late,
        replay.largest, replay.where * 1e-9, '; '.join(filter(None, notes)), left_out)


def _force(topic: str, message: Any) -> tuple[int, float]:
    """Return stamp in nanoseconds and newton of a disturbing force."""
    try:
        return _stamp(message), float(message.wrench.force.z)
    except (AttributeError, TypeError, ValueError):
        raise BadInputError(
            f'a message of {topic} is no force: expected geometry_msgs/msg/WrenchStamped'
        ) from None


def _note(custom_data: Mapping[str, str], pair: _Pair) -> str:
    """Return what makes the recorded samples differ from the motion."""
    notes = []
    counts = lost_messages(custom_data) or {}
    lost = [f'{count} of {name}' for name in (pair.commands, pair.beside(APPLIED),
                                              pair.beside(FORCE)) if (count := counts.get(name))]
    if lost:
        notes.append(f'the recorder lost messages, {" and ".join(lost)}: expected differences '
                     'from there on')
    texts = parameters_of(custom_data, 'plant', pair.space)
    noise = [
        f'{name} {text}' for name, none in (
            ('stretch_noise', '0'), ('rate_noise', '0'), ('stretch_bias', '0'),
            ('stretch_gain', '1'))
        if (text := _value(texts, pair, name, none)) not in (none, f'{none}.0')]
    if noise:
        notes.append(f'the samples are measured with {" and ".join(noise)}: expected differences '
                     'of that size, from the first sample on')
    return '; '.join(notes)


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


def _value(texts: Mapping[str, str], pair: _Pair, name: str, default: str) -> str:
    """Return a parameter as JSON: what is set for a joint goes before what is set for all."""
    own = texts.get(f'{pair.joint or _only_joint(texts)}.{name}', 'null')
    return texts.get(name, default) if own == 'null' else own


def _start(custom_data: Mapping[str, str], pair: _Pair, time: int) -> Any:
    """Return the simulation of the recorded actuator."""
    from hmsa_ros.core.parameters import ActuatorParameters
    from hmsa_ros.core.simulation import ActuatorSimulation
    texts = parameters_of(custom_data, 'plant', pair.space)

    def number(name: str, default: str = '') -> float:
        try:
            return float(json.loads(_value(texts, pair, name, default)))
        except (TypeError, ValueError):
            raise BadInputError(
                f'the bag does not tell parameter {name} of node {pair.space}/plant: expected a '
                'bag recorded while the plant was running') from None

    values = {field.name:
              number(f'actuator.{field.name}') * number(f'mismatch.{field.name}', '1.0')
              for field in fields(ActuatorParameters) if field.init}
    return ActuatorSimulation(
        ActuatorParameters(**values), time=time,
        slew_limit=number('slew_limit', '0.0') or math.inf,
        coil_time_constant=number('coil_time_constant', '0.0'))
