"""
Soak test: hours of operation, compressed in time, with every kind of fault.

Plant, planner and recorder run as real processes; the plant drives simulated time as fast as it
can, at 1 kHz or another rate. Cycles of two kinds alternate, each with a bag of its own. Calm
cycles contain random setpoints, sequences, stops, garbage on the planner's inputs, and kills of
planner or recorder; the bag holds all their samples and commands, and integrating the commands
again must give the samples. Rough cycles add garbage on every topic and service, and the plant is
paused, reset and killed too; there, no node may raise or end, and the recorder may lose nothing. A
second recorder, the witness, runs from the first cycle to the last, and the `mcap` package counts
what it has written.

The memory of each process is sampled throughout; it must not grow. To make growth visible, plant
and planner are killed in the first third only and run through the rest.
"""

from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import cycle
import math
import multiprocessing
import os
from pathlib import Path
import random
import shutil
import signal
import tempfile
from time import monotonic
from typing import Any

from benchmarks.faults.memory import Sample, Trend, trend, used
from benchmarks.measure import ros_domain
from benchmarks.sheet import Sheet

_HOUR = 3600.0
_STEP_NS = 1_000_000
#: Of the plant, in Hz.
RATE = 1000.0
_NANOSECONDS = 1_000_000_000
#: Wall-clock time; multiply by the factor of simulated time for simulated seconds.
_LEAD_SECONDS = 1.0
#: Of a file of the witness, in bytes.
_FILE_SIZE = 100_000_000
#: Initial part of a process's life, in simulated h, in which it may grow as buffers fill.
_SETTLE_HOURS = 0.25
#: Fraction of all hours in which plant and planner are killed; memory is watched in the rest.
_DEADLY_SHARE = 1.0 / 3.0
#: Initial part of a process's life, in simulated h, that is not drawn: it is still loading.
_LOADED_HOURS = 0.005
_LOOK_SECONDS = 2.0
#: Maximum simulated s between two diagnostics of the plant, which are 1 s of wall time apart.
_LARGEST_ROUND = 90.0
#: Samples per second, over `RATE`: what two cores manage with all processes, with a margin.
#: A recorder that is held up for more than a second then loses samples, since the plant keeps
#: only the last five thousand for readers that lag.
FACTOR = 5.0
_TOPICS = (
    'joint_states', 'flux_density_command', 'flux_density_applied', 'planner/status',
    'planner/plan', 'planner/setpoint', 'planner/joint_trajectory', '/diagnostics')
_NODES = ('plant', 'planner', 'recorder')
_WITNESS = 'witness'
#: Tolerance of stretch between a bag's samples and its commands, integrated again.
_SAME = 1e-9


@dataclass
class Cycle:
    """The result of one cycle and its bag."""

    kind: str  # 'calm' or 'rough'
    killed: str  # node that was killed in it; empty for none
    samples: int = 0  # of the plant in the bag
    missing: int = 0  # samples between others that are not in the bag, in calm cycles
    odd: int = 0  # intervals between samples that are not whole ms, in calm cycles
    lost: int = 0  # by the recorder's count; -1 if the bag has none
    difference: float = math.nan  # of the stretch from the commands integrated again
    late: int = 0  # commands that came after their time
    failure: str = ''  # why the bag could not be checked


@dataclass
class Witness:
    """The recording of the recorder that ran through all cycles."""

    hours: float  # of simulated time that it ran
    files: int
    samples: int  # of the plant's stretch, as the mcap package reads them
    messages: int  # of all topics, by the same package
    told: int  # messages of all topics by the bag's metadata
    lost: int  # by the recorder's count


@dataclass
class Result:
    """Result of the soak."""

    hours: float = 0.0  # simulated
    wall: float = 0.0  # wall-clock hours
    requests: int = 0  # setpoints, sequences and stops
    garbage: int = 0  # messages
    calls: int = 0  # of services
    cycles: list[Cycle] = field(default_factory=list)
    memory: dict[str, list[Sample]] = field(
        default_factory=lambda: {x: [] for x in (*_NODES, _WITNESS)})
    witness: Witness | None = None
    trends: dict[str, Trend] = field(default_factory=dict)
    traces: list[str] = field(default_factory=list)  # unhandled exceptions
    ended: list[str] = field(default_factory=list)  # nodes that ended without a request
    broken: list[str] = field(default_factory=list)  # cycles that could not be finished, and why
    statuses: list[int] = field(default_factory=list)  # of nodes that were asked to end

    def failures(self) -> list[str]:
        """Return the requirements that are not met, as sentences."""
        found = [f'unhandled exception in the {x}' for x in self.traces]
        found += [f'{x} ended by itself' for x in self.ended]
        found += self.broken
        found += [f'exit status {x}' for x in self.statuses if x]
        for number, one in enumerate(self.cycles):
            where = f'bag {number} ({one.kind}, {one.killed or "nobody"} killed)'
            if one.failure:
                found.append(f'{where}: {one.failure}')
            if one.lost > 0:
                found.append(f'{where}: {one.lost} messages lost')
            if one.missing or one.odd or not one.samples and not one.failure:
                found.append(f'{where}: {one.missing} of {one.samples} samples missing, '
                             f'{one.odd} out of step')
            if one.kind == 'calm' and not one.late and not one.difference < _SAME:
                found.append(f'{where}: differs by {one.difference:.1e} from its commands')
        if self.witness is not None and (
                self.witness.lost or self.witness.messages != self.witness.told):
            found.append(f'witness: {self.witness.messages} messages of {self.witness.told}, '
                         f'{self.witness.lost} lost')
        found += [
            f'memory of the {name} grows by {x.slope / 2**20:.2f} MiB an hour'
            for name, x in self.trends.items() if not x.flat]
        return found


def check_bag(folder: Path, kind: str, killed: str, step: int = _STEP_NS) -> Cycle:
    """Check a bag for gaps, integrate its commands again, and remove it if it has no fault."""
    from hmsa.bag.info import missing_messages
    from hmsa.bag.reader import BagReader
    from hmsa.bag.writer import recover
    from hmsa.errors import HmsaError
    from hmsa.runs.verify import verify
    from hmsa_ros.nodes.cdr import stamp_of

    found = Cycle(kind, killed)
    bag = folder
    try:
        if killed == 'recorder':
            bag = folder.with_name(folder.name + '_recovered')
            recover(folder, bag)
        reader = BagReader(bag)
        lost = missing_messages(reader.custom_data, 'lost')
        found.lost = -1 if lost is None else sum(lost.values())
        before = 0
        for message in reader.messages(('/joint_states',)):
            found.samples += 1
            if kind == 'rough':
                # Time jumps, and the samples include garbage.
                continue
            now = stamp_of(message.data)
            if before:
                found.missing += (now - before) // step - 1
                found.odd += (now - before) % step != 0
            before = now
        if kind == 'calm':
            verification, = verify(bag)
            found.difference = verification.largest_difference
            found.late = verification.late_count
    except HmsaError as error:
        found.failure = str(error)
    # A bag with a fault is kept as long as the folder.
    if not Result(cycles=[found]).failures():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(bag, ignore_errors=True)
    return found


def read_witness(folder: Path, hours: float) -> Witness:
    """Count the messages of a long recording with a reader independent of this package."""
    from mcap.reader import make_reader

    from hmsa.bag.info import summarize

    samples = messages = 0
    files = sorted(folder.glob('*.mcap'))
    for path in files:
        with open(path, 'rb') as file:
            for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages(
                    log_time_order=False):
                messages += 1
                samples += channel.topic == '/joint_states'
    bag = summarize(folder)
    return Witness(hours, len(files), samples, messages, bag.message_count, bag.lost or 0)


class Soak:
    """
    Real processes under stress; a context manager that ends them.

    Parameters
    ----------
    folder : Path
        Folder for logs and bags.
    domain : int
        ROS domain for this alone.
    seed : int
        Seed of all random choices.
    factor : float
        Requested ratio of simulated to real time of the plant; 0 for as fast as possible.
    rate : float
        Rate of the plant in Hz.

    Attributes
    ----------
    result : Result
        Result so far.
    seconds : float
        Simulated seconds so far.

    """

    def __init__(
            self, folder: Path, domain: int, seed: int, factor: float, rate: float = RATE) -> None:
        """Start plant, planner and witness."""
        from benchmarks.faults.rig import Rig

        self.result = Result()
        self.seconds = 0.0
        self._dice = random.Random(seed)
        self._factor = factor
        self._rate = rate
        self._lead = _LEAD_SECONDS * (factor or FACTOR)
        self._begin = monotonic()
        self.rig = Rig(folder, domain, watch=False)
        self._children: dict[str, Any] = {}
        self._lives = dict.fromkeys((*_NODES, _WITNESS), 0)
        self._born = dict.fromkeys((*_NODES, _WITNESS), 0.0)
        self._plant_time = 0.0
        self._looked = 0.0
        self._asked: list[tuple[Any, Any]] = []
        self._clients: dict[str, tuple[Any, type[Any]]] = {}
        self._bags = 0
        # Bags are checked in a separate process, so that the next cycle does not wait, and at low
        # priority, so that the recorder is not slowed down.
        self._pool = ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context('spawn'), initializer=os.nice,
            initargs=(19,))
        self._checks: list[Future[Cycle]] = []
        self._witnessed = Path()
        self._start('plant')
        self._start('planner')
        self._start_witness()
        self.rig.ready('planner')
        self._take_up_time()
        self._topics: list[tuple[Any, Any]] = []
        self._publish_inputs()

    def __enter__(self) -> 'Soak':
        """Return the soak."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all processes."""
        for name in ('planner', 'plant', _WITNESS):
            if name in self._children:
                self.result.statuses.append(self._children[name].end())
        self.result.witness = read_witness(
            self._witnessed, self.seconds / _HOUR - self._born[_WITNESS])
        self.rig.__exit__()
        self.result.traces += self.rig.traces()
        self.result.cycles += [x.result() for x in self._checks]
        self._pool.shutdown()
        self.result.hours = self.seconds / _HOUR
        self.result.wall = (monotonic() - self._begin) / _HOUR
        for name, samples in self.result.memory.items():
            self.result.trends[name] = trend(
                samples, min(_SETTLE_HOURS, 0.3 * self.result.hours))

    # -- processes, time and memory ------------------------------------------------------------

    def _start(self, name: str, alias: str = '', /, **more: object) -> None:
        own: dict[str, dict[str, object]] = {
            'plant': {'publish_clock': True, 'real_time_factor': self._factor,
                      'publish_rate': self._rate},
            'planner': {'use_sim_time': True, 'lead_time': self._lead,
                        'short_spell': 'continue'},
            'recorder': {'use_sim_time': True,
                         'record.topics': '[' + ', '.join(_TOPICS) + ']'},
        }
        alias = alias or name
        self._children[alias] = self.rig.start(
            name, own[name] | more, {'__node': alias} if alias != name else None)
        self._lives[alias] += 1
        self._born[alias] = self.seconds / _HOUR

    def _start_witness(self) -> None:
        self._witnessed = self.rig.folder / f'{_WITNESS}{self._lives[_WITNESS]}'
        self._start('recorder', _WITNESS, **{
            'storage.uri': self._witnessed, 'storage.max_bagfile_size': _FILE_SIZE})

    def _take_up_time(self) -> None:
        """Wait for the time of a plant that was just started."""
        self.rig.diagnostics.clear()
        self.rig.spin_until(
            lambda: not math.isnan(self.rig.value('plant', 'time')), 'the time of the plant')
        self._plant_time = self.rig.value('plant', 'time')

    def _look(self) -> None:
        """Serve callbacks briefly, update the time, sample memory, detect ended nodes."""
        self.rig.spin(0.01)
        time = self.rig.value('plant', 'time')
        passed = time - self._plant_time
        # A larger or negative difference belongs to another plant's time.
        if 0.0 < passed < _LARGEST_ROUND:
            self.seconds += passed
        if not math.isnan(passed):
            self._plant_time = time
        self._asked = [x for x in self._asked if not x[1].done()]
        while len(self._asked) > 20:
            client, future = self._asked.pop(0)
            client.remove_pending_request(future)
        if monotonic() - self._looked < _LOOK_SECONDS:
            return
        self._looked = monotonic()
        hours = self.seconds / _HOUR
        gone = []
        for name, child in self._children.items():
            if child.alive:
                self.result.memory[name].append(Sample(
                    hours, self._lives[name], hours - self._born[name],
                    *used(child.popen.pid)))
            else:
                self.result.ended.append(f'{name} with status {child.popen.returncode}')
                gone.append(name)
        for name in gone:
            del self._children[name]
            if name in ('plant', 'planner'):
                self._start(name)

    def _pass(self, seconds: float, act: Callable[[], None] | None = None) -> None:
        """Let simulated time pass, calling ``act`` about a hundred times a second."""
        end = self.seconds + seconds
        patience = monotonic() + 60.0 + seconds
        while self.seconds < end:
            if monotonic() > patience:
                raise TimeoutError(f'{seconds:g} simulated seconds did not pass')
            if act is not None:
                act()
            self._look()

    # -- disturbances --------------------------------------------------------------------------

    def cycle(self, kind: str, seconds: float, victim: str) -> None:
        """Run one cycle with a bag of its own; kill the victim half way through."""
        bag = self.rig.folder / f'bag{self._bags}'
        self._bags += 1
        self._start('recorder', **{'storage.uri': bag})
        self.rig.spin_until(self._recording, 'the recorder to listen to all topics')
        # Let commands from before the bag take effect, since the bag does not contain them.
        self._pass(2.0 * self._lead)
        act = self._act_calmly if kind == 'calm' else self._act_roughly
        self._pass(0.5 * seconds, act)
        if victim:
            self._kill(victim)
        if victim != 'recorder':
            self._pass(0.5 * seconds, act)
        if kind == 'rough':
            self._put_right()
        self._pass(2.0 * self._lead)
        recorder = self._children.pop('recorder', None)
        if recorder is not None:
            self.result.statuses.append(recorder.end())
        for name in [x for x in self.rig.diagnostics if x.startswith('recorder')]:
            del self.rig.diagnostics[name]
        self._checks.append(self._pool.submit(
            check_bag, bag, kind, victim, round(_NANOSECONDS / self._rate)))

    def start_again(self, why: str) -> None:
        """Restart all nodes after a cycle that could not be finished, which is a failure."""
        self.result.broken.append(why)
        self._publish_inputs()
        for child in self._children.values():
            child.end(signal.SIGKILL)
        self._children.clear()
        self._start('plant')
        self._start('planner')
        self._start_witness()
        self._take_up_time()

    def _recording(self) -> bool:
        for name, status in self.rig.diagnostics.items():
            if name.startswith('recorder') and 'subscribed' in status:
                done, _, wanted = status['subscribed'].partition('/')
                return done.strip() == wanted.strip()
        return False

    def _kill(self, name: str) -> None:
        self._children.pop(name).end(signal.SIGKILL)
        if name == 'planner':
            self._start(name)
        elif name == 'plant':
            # Every other plant starts at the initial time: time jumps back.
            ahead = self._plant_time + 100.0 if self._dice.random() < 0.5 else 1.0
            self._start(name, start_time=ahead)
            self._take_up_time()

    def _request(self) -> None:
        """Send a valid request, often before the last move is complete."""
        from std_srvs.srv import Trigger

        from hmsa_ros.nodes.conversions import to_trajectory

        dice = self._dice
        self.result.requests += 1
        choice = dice.random()
        if choice < 0.5:
            for _ in range(dice.choice((1, 1, 1, 5))):
                self.rig.publish_setpoint(dice.uniform(0.7, 1.6))
        elif choice < 0.9:
            end, points = 0.0, []
            for _ in range(dice.randrange(1, 6)):
                end += dice.uniform(0.005, 0.3)
                points.append((dice.uniform(0.7, 1.6), round(end * _NANOSECONDS)))
            self.rig.publish_trajectory(to_trajectory(points, 'actuator'))
        else:
            self._call(Trigger, '/planner/stop', Trigger.Request())

    def _rubbish(self, *, calm: bool) -> None:
        """Send garbage; in calm cycles only where it cannot reach the plant or checked topics."""
        from benchmarks.faults import garbage
        from hmsa.interfaces import topics
        from hmsa_ros.nodes.ros_entities import interface_class

        inputs = [
            x for x in self._topics
            if not calm or x[0] in (topics.SETPOINT, topics.JOINT_TRAJECTORY)]
        if not calm and self._dice.random() < 0.95:
            # Send little of it: each message is a jump of time.
            inputs = [x for x in inputs if x[0] != topics.CLOCK_TOPIC]
        topic, publisher = self._dice.choice(inputs)
        made = garbage.message if self._dice.random() < 0.5 else garbage.encoding
        # The middleware rejects some messages, which then never arrive.
        with suppress(Exception):
            publisher.publish(made(interface_class(topic.type), self._dice))
        self.result.garbage += 1

    def _act_calmly(self) -> None:
        if self._dice.random() < 0.7:
            self._request()
        else:
            self._rubbish(calm=True)

    def _act_roughly(self) -> None:
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter
        from std_srvs.srv import SetBool

        from benchmarks.faults.inputs import wild_request
        from hmsa_ros.nodes.ros_entities import interface_class

        choice = self._dice.random()
        if choice < 0.4:
            self._request()
        elif choice < 0.8:
            self._rubbish(calm=False)
        elif choice < 0.9:
            owner = self._dice.choice(_NODES)
            try:
                services = self.rig.node.get_service_names_and_types_by_node(owner, '/')
            except Exception:  # rclpy has a private class for a missing node
                return
            if services:
                name, types = self._dice.choice(services)
                kind = interface_class(types[0])
                self._call(kind, name, wild_request(kind, name, self._dice))
        else:
            # An earlier call may have paused or slowed the plant, which would stop the soak.
            self._call(SetBool, '/plant/set_paused', SetBool.Request(data=False))
            self._call(SetParameters, '/plant/set_parameters', SetParameters.Request(parameters=[
                Parameter('real_time_factor', value=self._factor).to_parameter_msg()]))

    def _call(self, kind: type[Any], name: str, request: Any) -> None:
        """Call a service without waiting for the response."""
        if name not in self._clients:
            self._clients[name] = self.rig.node.create_client(kind, name), kind
        client = self._clients[name][0]
        if client.service_is_ready():
            self._asked.append((client, client.call_async(request)))
            self.result.calls += 1

    def _publish_inputs(self) -> None:
        """Create publishers for garbage; this removes latched garbage of the previous ones."""
        from benchmarks.faults.inputs import input_topics

        for _, publisher in self._topics:
            self.rig.node.destroy_publisher(publisher)
        self._topics = [
            (topic, self.rig.publisher(topic, owner)) for topic, owner in input_topics()]

    def _put_right(self) -> None:
        """Undo settings that garbage may have changed."""
        from std_srvs.srv import SetBool

        from hmsa.interfaces import topics

        self._publish_inputs()
        rig = self.rig
        # Ask only nodes that are running.
        self._looked = 0.0
        self._look()
        rig.ready(*self._children)
        rig.call(topics.SET_PAUSED, 'plant', SetBool.Request(data=False))
        rig.set_parameters(
            'plant', use_sim_time=False, real_time_factor=self._factor, step_count=1,
            reset_stretch=0.0, reset_rate=0.0)
        rig.set_parameters(
            'planner', use_sim_time=True, flux_density_min=-0.5, flux_density_max=0.5,
            shaper='two_step', short_spell='continue', robust_order=2)
        rig.call(topics.RESET, 'plant')
        self._pass(2.0 * self._lead)
        rig.publish_setpoint(1.0)
        self._pass(2.0 * self._lead)


def run(
        folder: Path, domain: int, *, hours: float, minutes: float, length: float,
        factor: float, rate: float = RATE, seed: int = 1) -> Result:
    """Stress real processes for hours of simulated time or minutes of wall time."""
    kinds = cycle((
        ('calm', 'planner'), ('rough', 'plant'), ('calm', 'recorder'), ('rough', ''),
        ('calm', ''), ('rough', 'planner'), ('calm', ''), ('calm', '')))
    from benchmarks.faults.rig import hushed
    from hmsa.errors import HmsaError

    with hushed(folder / 'hushed.log') as stderr, Soak(folder, domain, seed, factor, rate) as soak:
        end = monotonic() + 60.0 * minutes
        while soak.seconds < hours * _HOUR and monotonic() < end:
            kind, victim = next(kinds)
            if victim != 'recorder' and soak.seconds > _DEADLY_SHARE * hours * _HOUR:
                victim = ''
            try:
                soak.cycle(kind, length, victim)
            except (HmsaError, TimeoutError) as error:
                soak.start_again(f'{kind} cycle, {victim or "nobody"} killed: {error}')
            trends = ', '.join(
                f'{name} {x[-1].own / 2**20:.1f}' for name, x in soak.result.memory.items() if x)
            print(f'{soak.seconds / _HOUR:.2f} h, {kind} {victim}: MiB {trends}',
                  file=stderr, flush=True)
    return soak.result


def draw(result: Result, file: Path) -> None:
    """Draw the memory of the processes over simulated time as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for number, (name, samples) in enumerate(result.memory.items()):
        for life in sorted({x.life for x in samples}):
            part = [x for x in samples if x.life == life and x.own and x.age > _LOADED_HOURS]
            axes.plot(
                [x.time for x in part], [x.own / 2**20 for x in part], color=f'C{number}',
                lw=1.0, label=name if life == 1 else None)
    axes.set_xlabel('simulated time (h)')
    axes.set_ylabel('anonymous memory (MiB)')
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(loc='upper right', fontsize='small', ncols=len(result.memory))
    figure.savefig(file, dpi=120)


def report(result: Result, rate: float = RATE) -> list[str]:
    """Return the results as sentences for the console and the page."""
    calm = [x for x in result.cycles if x.kind == 'calm']
    checked = [x.difference for x in calm if not x.late and not math.isnan(x.difference)]
    lines = [
        f'Over DDS, four processes: {result.hours:.2f} h of simulated time at {rate:g} Hz in '
        f'{60.0 * result.wall:.1f} min, {result.hours / result.wall:.1f} times as fast as real '
        f'time; {result.requests} requests, {result.garbage} messages of garbage, '
        f'{result.calls} calls, {sum(bool(x.killed) for x in result.cycles)} kills.',
        f'{len(result.traces)} unhandled exceptions, {len(result.ended)} nodes ended by '
        'themselves.',
        f'{len(result.cycles)} bags with {sum(x.samples for x in result.cycles)} samples: '
        f'{sum(max(x.lost, 0) for x in result.cycles)} messages lost; {len(calm)} calm ones: '
        f'{sum(x.missing for x in calm)} samples missing, {sum(x.odd for x in calm)} not exactly '
        f'{1e3 / rate:g} ms after the last; largest difference to the commands integrated anew '
        f'{max(checked, default=math.nan):.1e} in {len(checked)} of '
        f'them ({sum(bool(x.late) for x in calm)} with late commands).']
    if result.witness is not None:
        seen = result.witness
        lines.append(
            f'A recorder lived for {seen.hours:.2f} h of it: {seen.files} files, {seen.samples} '
            f'samples and {seen.messages} messages as the mcap package counts them, {seen.told} '
            f'by its own metadata, {seen.lost} lost.')
    return [*lines, *(
        f'Memory of the {name}: {_trend_text(x)}.' for name, x in result.trends.items())]


def _trend_text(found: Trend) -> str:
    """Return a trend in words."""
    if not found.samples:
        return 'no process lived long enough to tell'
    return (f'{found.slope / 2**20:+.3f} +- {found.error / 2**20:.3f} MiB an hour in the second '
            f'halves of its lives, of up to {found.span:.2f} h: '
            f'{"flat" if found.flat else "not flat"}')


def compare(
        *, quick: bool, hours: float = 8.0, minutes: float = math.inf,
        factor: float | None = None, rate: float = RATE, picture: Path | None = None) -> Sheet:
    """Stress the processes; passed if all requirements are met."""
    length = 300.0
    if factor is None:
        factor = FACTOR * max(RATE / rate, 1.0)
    if quick:
        hours, minutes, length = 0.05, 0.4, 30.0
    with tempfile.TemporaryDirectory(prefix='hmsa_soak_') as folder:
        result = run(
            Path(folder), ros_domain(), hours=hours, minutes=minutes, length=length,
            factor=factor, rate=rate)
    if picture is not None:
        draw(result, picture)
    failures = result.failures()
    return Sheet(
        'soak', 'Soak', (), (), {**asdict(result), 'failures': failures}, not failures,
        report(result, rate), [f'FAILED: {x}' for x in failures])
