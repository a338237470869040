"""
The sequence of the paper with real ROS 2 processes, recorded and evaluated.

Planner, plant and recorder run as separate processes and communicate over DDS on this host. The
plant publishes the time and runs in slow motion, since the whole sequence lasts 0.13 s for the
silicone block of `paper_actuator`.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from hmsa.errors import HmsaError
from hmsa.judge.records import Tolerances
from hmsa.model.parameters import paper_actuator
from hmsa.report.evaluation import MoveResult
from hmsa.report.outcome import findings_of
from hmsa.runs.bags import read_runs
from hmsa.runs.levels import without_repeats
from hmsa_ros.clients.adapting import AdaptingResult, FACTOR, second_act
from hmsa_ros.clients.experiment import conduct, Experiment
from hmsa_ros.clients.processes import NodeProcess

#: First expansion sequence of the paper: (stretch, duration) in dimensionless time (Figs. 4, 5).
SEQUENCE = ((1.10, 10.0), (1.20, 10.0), (1.40, 10.0))
REAL_TIME_FACTOR = 0.02
PUBLISH_RATE = 20_000.0
LEAD_TIME = 0.05
#: Largest residual vibration, as a fraction of the step, of a setpoint that counts as reached.
LARGEST_RESIDUAL = 1e-6
# Time is paused until all nodes are ready.
_NODES = (
    NodeProcess('plant', {
        'publish_clock': True, 'start_paused': True, 'real_time_factor': REAL_TIME_FACTOR,
        'publish_rate': PUBLISH_RATE}),
    NodeProcess('planner', {'use_sim_time': True, 'lead_time': LEAD_TIME}))


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
    """Run the sequence of the paper in a prepared folder, and evaluate the bag."""
    experiment = Experiment(folder, [
        ((stretch,), span * paper_actuator().time_unit) for stretch, span in SEQUENCE], _NODES)
    exits = conduct(experiment, progress).exits
    progress('evaluating the bag', 1.0)
    picture, second = folder / 'run.png', folder / 'adapting.png'
    results = _evaluate(experiment.bag, picture)
    progress('a plant that is not as planned', 1.0)
    return DemoResult(results, exits, experiment.bag, picture, second_act(second), second)


def _evaluate(bag: Path, picture: Path) -> tuple[SetpointResult, ...]:
    """Read the run from the bag, evaluate and plot it."""
    from hmsa.report.arrivals import Part
    from hmsa.report.paper import SCREEN
    from hmsa.report.picture import draw

    run, = read_runs(bag)
    levels = without_repeats(run.commands)[0]
    part = Part.of(run)
    if len(part.evaluation.results) != len(SEQUENCE) or len(levels) != 2 * len(SEQUENCE):
        raise HmsaError(
            f'{len(part.evaluation.results)} of {len(SEQUENCE)} setpoints were carried out, with '
            f'{len(levels)} commands: expected all, with {2 * len(SEQUENCE)}; if the machine is '
            'busy and commands come late, try again')
    found = findings_of(run, Tolerances(LARGEST_RESIDUAL, LARGEST_RESIDUAL, 0.0))
    results = tuple(
        SetpointResult(**asdict(x), finding=found[x.place].to_dict())
        for x in part.evaluation.results)
    draw(picture, [part], SCREEN)
    return results
