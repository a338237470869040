"""A laboratory in virtual time: a planner runtime, and an actuator integrated with SciPy."""

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

from at_work import AtWork, MS, planner, START
from identification_oracle import force_of
import numpy as np
from scipy.constants import mu_0
from scipy.integrate import solve_ivp

from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa_ros.runtime.records import EstimateChanged, ObservedSample, Settings, StretchRequest

# Integration ahead of the present time, in ns.
_AHEAD = 200 * MS


def slow(block: ActuatorParameters) -> ActuatorParameters:
    """Return a block of ten times the size, with a time scale of 44 ms."""
    return replace(
        block, half_length=10.0 * block.half_length, half_thickness=10.0 * block.half_thickness,
        damping_coefficient=100.0 * block.damping_coefficient)


@dataclass
class Plant:
    """An actuator; times in ns."""

    block: ActuatorParameters
    time: int = START
    lag: float = 0.0  # lag of the coil in s
    ratio: float = 0.0  # ratio of a viscoelastic branch
    tau: float = 0.1  # relaxation time of the branch in s
    limit: float = math.inf  # limit of the amplifier in T

    def __post_init__(self):
        self.levels = [(self.time, 0.0)]  # present and future levels
        self.state = np.array([1.0, 0.0, 0.0, 0.0])
        self.begin, self.end, self.solution = self.time, self.time, None

    def command(self, stamp, level):
        stamp = max(stamp, self.time)
        self.levels = [x for x in self.levels if x[0] < stamp]
        self.levels.append((stamp, float(np.clip(level, -self.limit, self.limit))))
        self.end = min(self.end, stamp) if self.solution is not None else self.end

    def advance(self, time):
        """Return the stretch at a time, and the levels that took effect until then."""
        before, now = self.time, self.time
        while now < time:
            if self.solution is None or now >= self.end:
                self._integrate(now)
            now = min(self.end, time)
            self.state = self.solution(now / 1e9)
        self.time = time
        changes = [x for x in self.levels if before < x[0] <= time]
        return float(self.state[0]), changes

    def _integrate(self, now):
        level = [x[1] for x in self.levels if x[0] <= now][-1]
        self.end = min([x[0] for x in self.levels if x[0] > now] + [now + _AHEAD])
        block = self.block
        inertia = block.density * block.half_length ** 2
        c1 = 2.0 * (block.half_thickness / block.half_length) ** 2
        damping = block.damping_coefficient * block.half_thickness / (8.0 * block.half_length ** 2)

        def slope(_, state):
            stretch, rate, relaxed, field = state.tolist()
            elastic = force_of(stretch, block.chain_limit)
            acting = field if self.lag else level
            total = (
                block.remanence * acting / mu_0 - block.shear_modulus * (
                    elastic + self.ratio * (elastic - relaxed)) - damping * rate
                + 0.25 * inertia * rate * rate / stretch ** 4)
            return [rate, total / (inertia * (stretch ** -3 + c1) / 6.0),
                    (elastic - relaxed) / self.tau,
                    (level - field) / self.lag if self.lag else 0.0]

        self.solution = solve_ivp(
            slope, (now / 1e9, self.end / 1e9), self.state, method='DOP853', rtol=1e-9,
            atol=1e-10, dense_output=True).sol


class Bench(AtWork):
    """A runtime, a plant and a sensor; `sense` returns samples (timestamp, stretch) of it."""

    def __init__(
            self, plant: Plant, nominal: ActuatorParameters, noise: float, *, lead: int = 2 * MS,
            delay: int = 2 * MS, seed: int = 0, limit: float = 0.5, report=True, glances=False,
            **settings):
        self.plant, self.noise, self.delay = plant, noise, delay
        self.random = np.random.default_rng(seed)
        self.sense: Callable = lambda time, stretch: [(time, stretch)]
        self.report = report
        self.effort: Callable = lambda: math.nan  # field in T reported by the device
        self.wire = []
        self.sent = []
        self.glances, self.newest = glances, None  # whether requests see the newest sample
        super().__init__(
            {'a': planner(
                nominal, flux_density_min=-limit, flux_density_max=limit, lead_time=lead)},
            Settings(**{'takeover_timeout': 0, 'heartbeat_period': 0, 'feedback': 'adapt',
                        **settings}), START, one_clock=lambda: True, glance=self.glance)

    def glance(self):
        return [('a', self.newest)] if self.glances and self.newest else []

    @property
    def estimates(self):
        return self.outputs_of(EstimateChanged)

    @property
    def message(self):
        return self.estimates[-1].message

    def rest(self, span):
        """Skip time without motion, observers or samples."""
        self.now += span
        self.plant.time, self.plant.solution = self.now, None

    def pass_time(self, span):
        """Advance in steps of 1 ms; return times in ns and true stretches."""
        seen, end = [], self.now + span
        while self.now < end:
            for x in self.tick():
                self.sent.append((x.stamp, x.flux_density))
                self.plant.command(x.stamp, x.flux_density)
            self.now += MS
            stretch, changes = self.plant.advance(self.now)
            seen.append((self.now, stretch))
            if self.report:
                for stamp, level in changes:
                    self.runtime.applied('a', stamp, level)
            noisy = stretch + self.noise * self.random.standard_normal()
            self.wire += [(self.now + self.delay, *x) for x in self.sense(self.now, noisy)]
            while self.wire and self.wire[0][0] <= self.now:
                _, stamp, value = self.wire.pop(0)
                self.newest = ObservedSample(stamp, value, math.nan, self.effort(), came=self.now)
                self.show(stamp, value, flux_density=self.effort())
        return np.array(seen)

    def move(self, target, hold):
        """Move to a target; return vibration and steady-state error in % of the step."""
        planner, before = self.planner, self.now
        start = planner.plan.segments[-1].stretch if planner.plan.segments else 1.0
        self.runtime.request(StretchRequest('a', target))
        segment = planner.plan.segments[-1]
        seen = self.pass_time(hold)
        arrival = max(segment.arrival or 0, before)
        unit = planner.model.units.time
        cycle = round(3.0 * unit * 1e9)
        early = seen[(seen[:, 0] >= arrival) & (seen[:, 0] < arrival + cycle), 1]
        late = seen[seen[:, 0] >= self.now - cycle, 1]
        step = 100.0 / abs(target - start)
        return step * np.ptp(early), step * (np.mean(late) - target)


def paper(t44: bool, **factors):
    """Return nominal and true block."""
    block = slow(paper_actuator()) if t44 else paper_actuator()
    return block, replace(block, **{x: y * getattr(block, x) for x, y in factors.items()})
