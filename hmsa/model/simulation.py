"""
Response of the actuator to a command, sampled or step by step.

Commands take effect exactly at their times: each piece between two changes of level is integrated
separately. Conversely, the stretch is a flat output: the equation of motion determines the load
from a path of the stretch (M. Fliess, J. Lévine, P. Martin, P. Rouchon, Int. J. Control 61, 1327
(1995)).
"""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa import motion
from hmsa.errors import BadInputError, HmsaError
from hmsa.model import law
from hmsa.model.actuators import Actuators, RTOL, Setup
from hmsa.model.creep import Creep, MAXWELL
from hmsa.model.delivery import CommandSchedule, Delivery, IDEAL, Piece, ramps
from hmsa.model.equations import acceleration, Array, elastic_force
from hmsa.model.moves import Level, State
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters

__all__ = [
    'ActuatorSimulation', 'follow', 'longest_motion', 'response', 'RTOL',
    'sampled', 'simulate', 'too_large']

# Time constants after which a motion has settled, and periods after which its phase is uncertain.
_SETTLED = 40.0
_MOST_PERIODS = 2000.0
# Stress that counts as zero, and tolerance of the relaxation without inertia.
_NOTHING, _SLOWLY = 1e-12, 1e-12
#: The message if an integration does not end.
STUCK = 'the integration ran out of steps: the load is too large to follow'


def simulate(
        switches: ArrayLike, loads: ArrayLike, times: ArrayLike,
        material: NondimensionalParameters, *, stretch: float | None = None, rate: float = 0.0,
        slopes: ArrayLike | None = None) -> tuple[Array, Array]:
    """
    Sample the response to a piecewise constant or linear load; `sampled` does so for levels.

    Parameters
    ----------
    switches : array_like, shape (m,)
        Start times of the levels, increasing; the motion starts at the first.
    loads : array_like, shape (m,)
        Load beta from each time on.
    times : array_like, shape (n,)
        Sampling times, not decreasing, none before the first switch.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    stretch, rate : float
        State at the first switch; default at rest without a field.
    slopes : array_like, shape (m,), optional
        Rate of the load from each time on; default zero.

    Returns
    -------
    stretch, rate : ndarray, shape (n,)
        Samples.

    Raises
    ------
    BadInputError
        If shapes, order or range of the arguments are wrong.
    HmsaError
        If the integration fails.

    """
    switches, loads, times = _vector(switches), _vector(loads), _vector(times)
    slope = np.zeros_like(loads) if slopes is None else _vector(slopes)
    if not (switches.ndim == 1 and switches.size and switches.shape == loads.shape
            == slope.shape and times.ndim == 1):
        raise BadInputError(
            f'switches {switches.shape}, loads {loads.shape}, slopes {slope.shape}, times '
            f'{times.shape}: expected one-dimensional arrays, the first three of one length')
    if not all(np.all(np.isfinite(a)) for a in (switches, loads, slope, times)):
        raise BadInputError('switches, loads, slopes and times must be finite numbers')
    if np.any(np.diff(switches) < 0.0) or np.any(np.diff(times) < 0.0) or (
            times.size and times[0] < switches[0]):
        raise BadInputError(
            'switches and times must not decrease, and no time may lie before the first switch')
    stretch = material.rest if stretch is None else stretch
    material.check(stretch)
    seen, speed = observed(_sampled(
        np.column_stack([switches, loads, slope]), State(stretch, rate), times, material),
        material)
    return seen, speed


def follow(
        levels: Sequence[Level], state: State, end: float, material: NondimensionalParameters,
        delivery: Delivery) -> State:
    """Return the state at a time after the last level; arguments are not checked."""
    pieces, last = ramps(levels, state.ramps_from, end, delivery.slew)
    if material.creeps or delivery.lag > 0.0:
        return _follow_slowly(pieces, last, state, end, material, delivery)
    stretch, rate, _, *followed = _sampled(
        pieces, state, np.array([float(end)]), material)[:, 0].tolist()
    return State(stretch, rate, last, None, tuple(followed))


def followed_by(state: State, material: NondimensionalParameters) -> tuple[float, ...]:
    """
    Return the states of branches, and position and rate of each secondary mode.

    A state without them has relaxed branches, and modes that move with the first.
    """
    if len(state.followed) == len(material.rows):
        return state.followed
    count = len(material.branches)
    relaxed = state.followed[:count] if len(state.followed) >= count else (
        float(law.elastic_force(state.stretch, material.packed)),) * count
    return (*relaxed, *(state.stretch, state.rate) * len(material.modes.ratios))


def branches_of(state: State, material: NondimensionalParameters) -> tuple[float, ...]:
    """Return the branch states of a state: the elastic force that each branch has followed."""
    return followed_by(state, material)[:len(material.branches)]


def with_followed(
        material: NondimensionalParameters, followed: ArrayLike) -> Array:
    """Return branches with given branch states, as arguments of `hmsa.motion`."""
    branches = material.branches.copy()
    branches[:, motion.FOLLOWER] = followed
    return branches


def observed(rows: Array, material: NondimensionalParameters) -> Array:
    """Return stretch and rate of all modes together from rows of `sampled`, shape (2, m)."""
    seen = rows[:motion.FIELD]
    if not material.modes.ratios:
        return seen
    after = motion.FOLLOWED + len(material.branches)
    return np.array(material.observed(seen[0], seen[1], rows[after:]))


def paces(material: NondimensionalParameters, above: ArrayLike) -> Array:
    """Return the relaxation rates of branches with a stress over their ratio, in units of G."""
    given: Array = np.asarray(above, dtype=np.float64)
    given = np.where(np.abs(given) > _NOTHING, given, _NOTHING)
    found: Array = flow_rates(material, given) / given
    return found


def flow_rates(material: NondimensionalParameters, above: Array) -> Array:
    """Return the flow rates of branches with a stress over their ratio, in units of G."""
    rates = np.empty(len(above))
    motion.flow_rates(material.branches, above, rates)
    return rates


def sampled(
        levels: Sequence[Level], state: State, times: Array, material: NondimensionalParameters,
        delivery: Delivery = IDEAL, rtol: float = RTOL) -> Array:
    """
    Return stretch, rate, field and n branch states under levels, shape (3 + n, m).

    The stretch is that of the first mode; after the branch states come position and rate of each
    secondary mode. The state is that at the start of the first level; times (m,) do not decrease.
    Raise `HmsaError` if a load is too large to simulate.
    """
    pieces, _ = ramps(
        levels, state.ramps_from, max(float(times[-1]), levels[-1].time), delivery.slew)
    return _sampled(pieces, state, times, material, delivery.lag, rtol)


def response(
        actuator: ActuatorParameters, delivery: Delivery, times: Array, levels: Array, at: Array,
        start: float) -> tuple[Array, Array, Array]:
    """
    Return stretch, rate in 1/s and level at times in s (n,), from rest at a stretch.

    Levels (m,), in T or V, apply from their times in s on; before the first one, the level that
    holds the start applies. Errors are those of `sampled`.
    """
    units, material = actuator.units, actuator.nondimensional
    held = float(law.elastic_force(start, material.packed))
    loads = [Level(x / units.time, units.of_level(y)) for x, y in zip(
        times.tolist(), levels.tolist(), strict=True)]
    if times[0] > at[0]:
        loads.insert(0, Level(float(at[0]) / units.time, held))
    rows = sampled(loads, State(start, load=held), at / units.time, material, delivery)
    stretch, rate = observed(rows, material)
    return stretch, rate / units.time, units.level(rows[2])


def _sampled(
        pieces: Sequence[Piece] | Array, state: State, times: Array,
        material: NondimensionalParameters, lag: float = 0.0, rtol: float = RTOL) -> Array:
    switches, loads, slopes = np.array(pieces).T.copy()
    branches = material.rows.copy()
    if len(branches):
        branches[:, motion.FOLLOWER] = followed_by(state, material)
    out = np.empty((motion.FOLLOWED + len(branches), times.size))
    if not motion.sample(
            state.stretch, state.rate, loads[0] if math.isnan(state.load) else state.load,
            switches, loads, slopes, lag, times, material.packed, branches, rtol, out):
        raise HmsaError(STUCK)
    return out


def _follow_slowly(
        pieces: Sequence[Piece], last: float, state: State, end: float,
        material: NondimensionalParameters, delivery: Delivery) -> State:
    """Integrate until vibration has ended; from then on only the branches relax."""
    rings, amplifier = end, last if delivery.lag > 0.0 else None
    if material.creeps:
        rings = min(end, max(pieces[-1][0], 0.0) + longest_motion(last, material)
                    + delivery.lagging)
    stretch, rate, field, *followed = _sampled(
        pieces, state, np.array([float(rings)]), material, delivery.lag)[:, 0].tolist()
    if rings == end:
        return State(
            stretch, rate, last if amplifier is None else field, amplifier, tuple(followed))
    share = material.branches[:, motion.RATIO] / (1.0 + material.branches[:, motion.RATIO].sum())
    relaxed = _relaxed(np.array(followed[:len(share)]), last, share, end - rings, material)
    force = last + float(share @ (relaxed - last))
    stretch = float(law.equilibrium_stretch(force, material.packed))
    return State(
        stretch, 0.0, last, amplifier,
        (*relaxed.tolist(), *(stretch, 0.0) * len(material.modes.ratios)))


def _relaxed(
        followed: Array, last: float, share: Array, duration: float,
        material: NondimensionalParameters) -> Array:
    """Return the branch states after a duration without inertia, under a constant load."""
    # The elastic force is linear in the branch states, which follow it.
    if material.creep.law.kind == MAXWELL.kind:
        speeds = material.branches[:, motion.SPEED]
        values, vectors = np.linalg.eig(speeds[:, None] * (share - np.eye(len(share))))
        left = np.linalg.solve(vectors, followed - last)
        found: Array = last + np.real(vectors @ (left * np.exp(values * duration)))
        return found
    from scipy.integrate import solve_ivp  # slow to import

    def change(_: float, y: Array) -> Array:
        return flow_rates(material, last + share @ (y - last) - y)

    ended: Array = solve_ivp(
        change, (0.0, duration), followed, method='LSODA', rtol=_SLOWLY, atol=_SLOWLY).y[:, -1]
    return ended


def _vector(values: ArrayLike) -> Array:
    """Return the values as a new contiguous array."""
    return np.array(values, dtype=np.float64, ndmin=1, order='C')


def longest_motion(load: float, material: NondimensionalParameters) -> float:
    """Return the time after which motion under a load beta has settled, or an upper bound."""
    stretch = law.equilibrium_stretch(load, material.packed)
    frequency = law.natural_frequency(stretch, material.packed)
    longest = _MOST_PERIODS * 2.0 * math.pi / frequency
    decay = law.damping(stretch, material.packed) / (2.0 * law.mass(stretch, material.packed))
    if material.modes.ratios:
        decay = min(decay, frequency * material.modes.slowest_decay())
    if decay == 0.0:
        return longest
    if decay < frequency:
        return min(longest, _SETTLED / decay)
    # Overdamped: use the slower of the two decays.
    return _SETTLED * 2.0 * decay / frequency ** 2


class ActuatorSimulation:
    """
    Simulate one actuator.

    Set timestamped field levels with ``command(time_ns, tesla)``, step with
    ``advance(time_ns)``, and read `stretch` and `rate`.

    Parameters
    ----------
    actuator : ActuatorParameters
        Parameters in SI units.
    time : int
        Initial time in ns.
    stretch : float, optional
        Initial stretch at rest; by default that without field.
    slew_limit : float
        Rate of the amplifier's ramps in T/s; infinite for steps.
    coil_time_constant : float
        Time constant of the first-order coil lag in s; 0 for none.
    creep : Creep, optional
        Viscoelastic branches; by default those of the actuator.

    Examples
    --------
    >>> from hmsa.model.parameters import paper_actuator
    >>> block = ActuatorSimulation(paper_actuator())
    >>> lateness = block.command(0, 0.02)
    >>> block.advance(200_000_000)
    >>> print(f'{block.stretch:.3f}')
    1.056

    """

    def __init__(
            self, actuator: ActuatorParameters, *, time: int = 0, stretch: float | None = None,
            slew_limit: float = math.inf, coil_time_constant: float = 0.0,
            creep: Creep | None = None) -> None:
        """Start at rest."""
        self.actuator = actuator if creep is None else replace(actuator, creep=creep)
        self._setup = Setup(
            self.actuator, actuator.rest if stretch is None else stretch, slew_limit,
            coil_time_constant)
        self._all = Actuators([self._setup], time=time)

    @property
    def time(self) -> int:
        """Time of the state in ns; setting it skips the time in between."""
        return self._all.time

    @time.setter
    def time(self, time: int) -> None:
        self._all.time = time

    @property
    def stretch(self) -> float:
        """Stretch."""
        return float(self._all.stretch[0])

    @property
    def rate(self) -> float:
        """Stretch rate in 1/s."""
        return float(self._all.rate[0])

    @property
    def flux_density(self) -> float:
        """Present flux density in T."""
        return float(self._all.flux_density[0])

    @property
    def schedule(self) -> CommandSchedule:
        """Present and future commands in T."""
        return self._all.schedules[0]

    def reset(self) -> None:
        """Return to the initial state at rest, without future commands; time continues."""
        self._all.reset(0)

    def set_state(
            self, stretch: float, rate: float, flux_density: float,
            level: float | None = None) -> None:
        """Continue from another state, see `Actuators.set_state`."""
        self._all.set_state(0, stretch, rate, flux_density, level)

    def set_temperature(self, temperature: float) -> None:
        """Continue at a temperature in degrees Celsius, see `Actuators.set_temperature`."""
        self._all.set_temperature(0, self._setup, temperature)

    def command(self, stamp: int, flux_density: float) -> int:
        """Take a command in T, see `Actuators.command`; return its lateness in ns."""
        return self._all.command(0, stamp, flux_density)

    def force(self, stamp: int, force: float) -> None:
        """Take a disturbing force in N, see `Actuators.force`."""
        self._all.force(0, stamp, force)

    def equilibrium(self) -> float:
        """Return the equilibrium stretch under the present flux density."""
        return self._all.equilibrium(0)

    def advance(self, time: int) -> None:
        """Integrate to a time in ns; raise `HmsaError` if the load is too large to simulate."""
        failed = self._all.advance(time)
        self._all.changes.clear()
        if failed:
            self._all.time = failed[0][1]
            raise HmsaError(too_large(self.time, self.flux_density))


def too_large(time: int, flux_density: float) -> str:
    """Return the message for a load that is too large to simulate, at a time in ns and in T."""
    return (f'the integration stopped at {time} ns under {flux_density:g} T: the load is too '
            'large to follow')


def fade(share: Array) -> tuple[Array, Array, Array]:
    """Return a polynomial from 0 to 1, flat to third order at both ends, and two derivatives."""
    left = 1.0 - share
    return (share ** 4 * (35.0 - 84.0 * share + 70.0 * share ** 2 - 20.0 * share ** 3),
            140.0 * (share * left) ** 3, 420.0 * (share * left) ** 2 * (left - share))


def loads_for(
        stretch: Array, rate: Array, wanted: Array, material: NondimensionalParameters) -> Array:
    """Return the loads for given accelerations, which are linear in the load, (n,) each."""
    zero, one = (acceleration(stretch, rate, x, material) for x in (0.0, 1.0))
    return (wanted - zero) / (one - zero)


def held_along(
        times: Array, stretch: Array, followed: tuple[float, ...],
        material: NondimensionalParameters) -> tuple[Array, Array]:
    """
    Return the overstress (n,) of branches along a path, and the branch states (n, k).

    Raise `HmsaError` if the branches cannot be integrated.
    """
    forces = elastic_force(stretch, material)
    behind = np.empty((len(times), len(followed)))
    if not motion.trail(times, forces, with_followed(material, followed), behind):
        raise HmsaError(STUCK)
    return (forces[:, np.newaxis] - behind) @ material.branches[:, motion.RATIO], behind


def residual_vibration(
        time: ArrayLike, stretch: ArrayLike, *, arrival: float, end: float,
        step: float) -> float:
    """
    Return the peak-to-peak stretch after arrival as a fraction (not percent) of the step.

    Samples from ``arrival`` to ``end``, both included, count; ``time`` (n,) increases, in the same
    unit. Raise `HmsaError` for fewer than two of them, or a step of zero. 0 means rest.
    """
    time = np.asarray(time, dtype=np.float64)
    inside = (time >= arrival) & (time <= end)
    count = int(np.count_nonzero(inside))
    if count < 2 or step == 0.0:
        raise HmsaError(
            f'{count} samples between {arrival:g} and {end:g} after a step of {step:g}: '
            'expected at least two samples and a step')
    return float(np.ptp(np.asarray(stretch, dtype=np.float64)[inside]) / abs(step))
