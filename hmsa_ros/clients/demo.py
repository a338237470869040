"""
The sequence of the paper with real ROS 2 processes, recorded and evaluated, and an adapting plant.

Planner, plant and recorder run as separate processes and communicate over DDS on this host. The
plant publishes the time and runs in slow motion, since the whole sequence lasts 0.13 s for the
silicone block of `paper_actuator`.

In the second part, the actuator differs from its model: in open loop and adapting. Planner and
simulated plant run in one loop, as in ``hmsa controller``, but without ROS and in simulated time.
The block is ten times as long as in the first part, so that a camera resolves its first move.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from hmsa.errors import assume, HmsaError, UnusualWarning
from hmsa.judge.records import Tolerances
from hmsa.model.actuators import Setup
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.sensor import SensorErrors
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa.report.comparison import Part
from hmsa.report.evaluation import findings_of, MoveResult
from hmsa.runs.bags import read_runs
from hmsa.runs.record import without_repeats
from hmsa_ros.clients.experiment import conduct, Experiment
from hmsa_ros.clients.processes import NodeProcess
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest

#: Error factor of the shear modulus, unknown to the planner.
FACTOR = 1.2
_TARGETS, _HOLD = (1.4, 1.1), 0.8
_MS, _JOINT = 1_000_000, 'actuator'
# A camera at 200 Hz with 10 ms delay, noise and bias of the stretch; lead time of commands.
_PERIOD, _DELAY, _LEAD = 5 * _MS, 10 * _MS, 2 * _MS
_ERRORS = SensorErrors(stretch_noise=1e-3, stretch_bias=1e-3)
_LIMIT = 0.5

#: First expansion sequence of the paper: (stretch, duration) in dimensionless time (Figs. 4, 5).
SEQUENCE = ((1.10, 10.0), (1.20, 10.0), (1.40, 10.0))
REAL_TIME_FACTOR = 0.02
PUBLISH_RATE = 20_000.0
LEAD_TIME = 0.05
#: Largest residual vibration, as a fraction of the step, of a setpoint that counts as reached.
LARGEST_RESIDUAL = 1e-6
# Attempts to run the sequence: commands come late where the machine lets a node stand still for
# longer than the lead time, 2.5 s of real time.
_ATTEMPTS = 3
# Time is paused until all nodes are ready.
_NODES = (
    NodeProcess('plant', {
        'publish_clock': True, 'start_paused': True, 'real_time_factor': REAL_TIME_FACTOR,
        'publish_rate': PUBLISH_RATE}),
    NodeProcess('planner', {'use_sim_time': True, 'lead_time': LEAD_TIME}))


@dataclass(frozen=True)
class AdaptingResult:
    """Residual vibration and steady-state error of one move, as fractions of the step."""

    feedback: str
    stretch: float
    arrival: float
    vibration: float
    offset: float


def _carry_out(
        block: ActuatorParameters, feedback: str) -> tuple[Array, list[AdaptingResult]]:
    """Make the moves; return time in s with true stretch, and the result of each move."""
    true = replace(block, shear_modulus=FACTOR * block.shear_modulus)
    planner = Planner(block, Options(
        flux_density_min=-_LIMIT, flux_density_max=_LIMIT, lead_time=_LEAD))
    device = SimulatedDevice(
        [SimulatedJoint(Setup(true), errors=_ERRORS)], period=_PERIOD, measurement_delay=_DELAY)
    loop = Loop(
        PlannerGroup({_JOINT: planner}),
        Settings(takeover_timeout=0, feedback=feedback), device)
    loop.run(_MS)
    seen, results, before = [], [], 1.0
    for target in _TARGETS:
        begin = loop.now
        loop.runtime.request(StretchRequest(_JOINT, target))
        # The arrival as planned, before any correction.
        arrival = (planner.plan.segments[-1].arrival or begin) * 1e-9
        while loop.now < begin + _HOLD * 1e9:
            loop.run(loop.now + _MS)
            seen.append((loop.now * 1e-9, float(device.stretch[0])))
        track: Array = np.array(seen, dtype=np.float64)
        after = track[track[:, 0] >= arrival, 1]
        step, before = target - before, target
        results.append(AdaptingResult(
            feedback, target, arrival - begin * 1e-9, float(np.ptp(after)) / abs(step),
            (float(after[-1]) - target) / step))
    return track, results


def second_act(picture: Path) -> tuple[AdaptingResult, ...]:
    """Run the moves with feedback off and cautious, and plot both."""
    from hmsa.report import looks, style
    from hmsa.report.looks import SCREEN

    block = paper_actuator()
    block = replace(
        block, half_length=10.0 * block.half_length, half_thickness=10.0 * block.half_thickness,
        damping_coefficient=100.0 * block.damping_coefficient)
    results: list[AdaptingResult] = []
    with style.picture(picture, 2.8, SCREEN) as figure:
        axes = figure.add_subplot()
        for feedback, label, kind in (
                ('off', 'open loop', style.UNSHAPED), ('cautious', 'adapting', style.SHAPED)):
            track, found = _carry_out(block, feedback)
            results += found
            axes.plot(1e3 * track[:, 0], track[:, 1], label=label, **kind)
        times = 1e3 * _HOLD * np.arange(len(_TARGETS) + 1)
        axes.step(times, [*_TARGETS, _TARGETS[-1]], where='post', label='target',
                  **looks.SETPOINT.line(alpha=looks.SETPOINT.opacity))
        axes.set_title(
            f'shear modulus {100.0 * FACTOR - 100.0:+.0f} %, unknown to the planner')
        style.finish(axes, style.axis('time', 't', 'ms'), style.axis('stretch', r'\lambda'))
        axes.legend(loc='upper right')
    return tuple(results)


@dataclass(frozen=True)
class SetpointResult(MoveResult):
    """Result of one setpoint from the bag, with its finding for given tolerances."""

    finding: dict[str, object] = field(default_factory=dict)

    @property
    def reached(self) -> bool:
        """Whether the setpoint arrived and was held within `LARGEST_RESIDUAL`."""
        return self.finding['verdict'] == 'arrived'


@dataclass(frozen=True)
class DemoResult:
    """Results of the demo: setpoints, exit statuses by process, files, and the second part."""

    setpoints: tuple[SetpointResult, ...]
    exits: dict[str, int]
    bag: Path
    picture: Path
    adapting: tuple[AdaptingResult, ...]
    second: Path  #: figure of the second part

    @property
    def succeeded(self) -> bool:
        """Whether every setpoint was reached and every process ended without error."""
        return all(x.reached for x in self.setpoints) and not any(self.exits.values())

    def as_json(self) -> dict[str, object]:
        """Return the result for JSON."""
        return {
            'succeeded': self.succeeded, 'setpoints': [asdict(x) for x in self.setpoints],
            'exits': self.exits, 'bag': self.bag, 'picture': self.picture, 'adapting': {
                'shear_modulus_factor': FACTOR, 'picture': self.second,
                'moves': [asdict(x) for x in self.adapting]}}


def run_demo(folder: Path, progress: Callable[[str, float], None]) -> DemoResult:
    """
    Run the sequence of the paper in a prepared folder, and evaluate the bag.

    Raises
    ------
    HmsaError
        If a node fails, or the sequence is not carried out in any of the attempts.

    """
    experiment = Experiment(folder, [
        ((stretch,), span * paper_actuator().time_unit) for stretch, span in SEQUENCE], _NODES)
    for attempt in range(1, _ATTEMPTS + 1):
        exits = conduct(experiment, progress).exits
        progress('evaluating the bag', 1.0)
        run, = read_runs(experiment.bag)
        part = Part.of(run)
        if not (missing := _missing(part)):
            break
        if attempt == _ATTEMPTS:
            raise HmsaError(f'{missing}; if the machine is busy and commands come late, try again')
        kept = experiment.bag.rename(folder / f'late_{attempt}')
        assume(f'{missing}; commands come late on a busy machine, so that the sequence runs again '
               f'(bag kept in {kept})', UnusualWarning)
    picture, second = folder / 'run.png', folder / 'adapting.png'
    results = _evaluate(part, picture)
    progress('a plant that is not as planned', 1.0)
    return DemoResult(results, exits, experiment.bag, picture, second_act(second), second)


def _missing(part: Part) -> str:
    """Return what was not carried out; empty if everything was."""
    count, levels = len(part.evaluation.results), len(without_repeats(part.run.commands)[0])
    if (count, levels) == (len(SEQUENCE), 2 * len(SEQUENCE)):
        return ''
    return (f'{count} of {len(SEQUENCE)} setpoints were carried out, with {levels} commands: '
            f'expected all, with {2 * len(SEQUENCE)}')


def _evaluate(part: Part, picture: Path) -> tuple[SetpointResult, ...]:
    """Evaluate the run and plot it."""
    from hmsa.report.looks import SCREEN
    from hmsa.report.picture import draw

    found = findings_of(part.run, Tolerances(LARGEST_RESIDUAL, LARGEST_RESIDUAL, 0.0))
    results = tuple(
        SetpointResult(**asdict(x), finding=found[x.place].to_dict())
        for x in part.evaluation.results)
    draw(picture, [part], SCREEN)
    return results
