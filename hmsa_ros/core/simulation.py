"""
Response of the actuator to a command: sampled, or followed step by step as the plant does.

Commands take effect exactly at their times, inside the integration: each piece between two
changes of level is integrated on its own.
"""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa_ros.core import kernels
from hmsa_ros.core.model import (
    Array,
    damping,
    equilibrium_stretch,
    mass,
    natural_frequency,
    stretch_limits,
)
from hmsa_ros.core.parameters import ActuatorParameters, NondimensionalParameters
from hmsa_ros.core.schedule import CommandSchedule
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, HmsaError

#: Relative tolerance of the plant's integration.
RTOL = 1e-13
# Time constants after which nothing is left of a motion, and periods after which nobody knows
# its phase.
_SETTLED = 40.0
_MOST_PERIODS = 2000.0


def simulate(
        switches: ArrayLike, loads: ArrayLike, times: ArrayLike,
        material: NondimensionalParameters, *, stretch: float = 1.0, rate: float = 0.0,
        slopes: ArrayLike | None = None, rtol: float = RTOL) -> tuple[Array, Array]:
    """
    Sample the response to a piecewise constant or linear load.

    Parameters
    ----------
    switches : array_like, shape (m,)
        Times at which a level begins, increasing; the motion starts at the first.
    loads : array_like, shape (m,)
        Load beta from each switch on.
    times : array_like, shape (n,)
        Times to sample at, not decreasing, none before the first switch.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    stretch, rate : float
        State at the first switch.
    slopes : array_like, shape (m,), optional
        Change of the load per unit of time from each switch on; default none.
    rtol : float
        Relative tolerance.

    Returns
    -------
    stretch, rate : ndarray, shape (n,)
        Samples.

    Raises
    ------
    BadInputError
        If shapes, order or range of the arguments are wrong.
    HmsaError
        If the integration does not get through.

    """
    switches, loads, times = _vector(switches), _vector(loads), _vector(times)
    ramps = np.zeros_like(loads) if slopes is None else _vector(slopes)
    if not (switches.ndim == 1 and switches.size and switches.shape == loads.shape
            == ramps.shape and times.ndim == 1):
        raise BadInputError(
            f'switches {switches.shape}, loads {loads.shape}, slopes {ramps.shape}, times '
            f'{times.shape}: expected one-dimensional arrays, the first three of one length')
    if not all(np.all(np.isfinite(a)) for a in (switches, loads, ramps, times)):
        raise BadInputError('switches, loads, slopes and times must be finite numbers')
    if np.any(np.diff(switches) < 0.0) or np.any(np.diff(times) < 0.0) or (
            times.size and times[0] < switches[0]):
        raise BadInputError(
            'switches and times must not decrease, and no time may lie before the first switch')
    check_stretch(stretch, material.j_lim)
    out = np.empty((2, times.size))
    status = kernels.trajectory(
        float(stretch), float(rate), switches, loads, ramps, times, material.zeta, material.c1,
        1.0 / material.j_lim, float(rtol), out[0], out[1])
    if status != kernels.DONE:
        raise HmsaError('the integration ran out of steps: the load is too large to follow')
    return out[0], out[1]


def _vector(values: ArrayLike) -> Array:
    """Return a contiguous copy: any other layout would have the kernels compiled anew."""
    return np.array(values, dtype=np.float64, ndmin=1, order='C')


def longest_motion(load: float, material: NondimensionalParameters) -> float:
    """
    Return for how long motion under a constant load is worth following.

    Parameters
    ----------
    load : float
        Load beta.
    material : NondimensionalParameters
        zeta, J_lim and c1.

    Returns
    -------
    float
        Time after which it has settled, or, with next to no damping, some thousand periods.

    """
    stretch = equilibrium_stretch(load, material.j_lim)
    frequency = float(natural_frequency(stretch, material))
    longest = _MOST_PERIODS * 2.0 * math.pi / frequency
    decay = damping(material) / (2.0 * float(mass(stretch, material.c1)))
    if decay == 0.0:
        return longest
    if decay < frequency:
        return min(longest, _SETTLED / decay)
    # The slower of two decays.
    return _SETTLED * 2.0 * decay / frequency ** 2


def check_stretch(stretch: float, j_lim: float, name: str = 'stretch') -> None:
    """
    Refuse a stretch outside the limits.

    Parameters
    ----------
    stretch : float
        Value to check.
    j_lim : float
        Chain limit.
    name : str
        What the value is, for the message.

    Raises
    ------
    BadInputError
        If it is not finite or not between the limiting stretches.

    """
    lower, upper = stretch_limits(j_lim)
    if not lower < stretch < upper:
        raise BadInputError(
            f'{name} is {stretch:g}: expected a stretch between the limits {lower:.4f} and '
            f'{upper:.4f} of J_lim {j_lim:g}')


class ActuatorSimulation:
    """
    The actuator over time in SI units: takes stamped commands, advances to a time.

    Time is integer nanoseconds, so that it does not drift.

    Parameters
    ----------
    actuator : ActuatorParameters
        The block.
    time : int
        Time at the start in ns.
    stretch : float
        Stretch at the start, at rest and held by its flux density.
    slew_limit : float
        Largest change of the flux density in T/s that the amplifier makes; infinite for steps.

    Attributes
    ----------
    time : int
        Time in ns that the state belongs to.
    stretch, rate : float
        State; the rate in 1/s.
    flux_density : float
        In force, in T.
    schedule : CommandSchedule
        Commands in force and ahead, in T.

    Raises
    ------
    BadInputError
        If the stretch is outside the limits.

    """

    def __init__(
            self, actuator: ActuatorParameters, *, time: int = 0, stretch: float = 1.0,
            slew_limit: float = math.inf) -> None:
        """Start at rest."""
        self.actuator = actuator
        self._material = actuator.nondimensional
        check_stretch(stretch, self._material.j_lim, 'initial stretch')
        if not slew_limit > 0.0:
            raise BadInputError(f'slew limit is {slew_limit:g} T/s: expected a number above 0')
        self._slew = slew_limit / actuator.flux_density_unit * actuator.time_unit
        self._work = kernels.work_space()
        self._initial = (
            stretch,
            float(kernels.elastic_force(stretch, 1.0 / self._material.j_lim))
            * actuator.flux_density_unit)
        self.time = time
        self.reset()

    def reset(self) -> None:
        """Return to the initial state, at rest, with no command ahead; time goes on."""
        self.stretch, flux_density = self._initial
        self._rate = 0.0
        self._step = 0.0
        self.flux_density = flux_density
        self.schedule = CommandSchedule(flux_density)

    def set_state(self, stretch: float, rate: float, flux_density: float) -> None:
        """
        Go on from another state, with no command ahead.

        Parameters
        ----------
        stretch, rate : float
            State; the rate in 1/s.
        flux_density : float
            In force, in T.

        Raises
        ------
        BadInputError
            If the stretch is outside the limits.

        """
        check_stretch(stretch, self._material.j_lim)
        self.stretch = stretch
        self._rate = rate * self.actuator.time_unit
        self._step = 0.0
        self.flux_density = flux_density
        self.schedule = CommandSchedule(flux_density)

    @property
    def rate(self) -> float:
        """Stretch rate in 1/s."""
        return self._rate / self.actuator.time_unit

    def command(self, stamp: int, flux_density: float) -> int:
        """
        Take a command that applies from its stamp on.

        Parameters
        ----------
        stamp : int
            Time in ns from which the value applies; it supersedes all commands stamped at or
            after it.
        flux_density : float
            Signed flux density in T.

        Returns
        -------
        int
            How late the command is in ns, 0 if it is not; a late one applies at once.

        Raises
        ------
        BadInputError
            If the value is not finite or nobody could follow it.

        """
        load = flux_density / self.actuator.flux_density_unit
        # equilibrium_stretch keeps every finite load inside the limits; far beyond this bound
        # it is no longer distinguishable from the limit itself.
        if not abs(load) < 1e9:
            raise BadInputError(
                f'flux density is {flux_density:g} T: expected a finite value below '
                f'{1e9 * self.actuator.flux_density_unit:g} T')
        late = max(self.time - stamp, 0)
        self.schedule.insert(max(stamp, self.time), flux_density)
        return late

    def advance(self, time: int) -> None:
        """
        Integrate to a time, each command applied exactly at its stamp.

        Parameters
        ----------
        time : int
            Time in ns; one that is not ahead changes nothing but applies what is due.

        Raises
        ------
        HmsaError
            If the integration does not get through.

        """
        while True:
            change = self.schedule.next_stamp
            end = time if change is None else min(change, time)
            if end > self.time:
                self._integrate(end - self.time)
                self.time = end
            if change is None or change > time:
                return
            self.schedule.apply_next()
            if math.isinf(self._slew):
                self.flux_density = self.schedule.current
            self._step = 0.0

    def _integrate(self, duration: int) -> None:
        unit = self.actuator.flux_density_unit
        left = duration / NANOSECONDS / self.actuator.time_unit
        change = (self.schedule.current - self.flux_density) / unit
        if change != 0.0 and not math.isinf(self._slew):
            ramp = abs(change) / self._slew
            span = min(left, ramp)
            slope = math.copysign(self._slew, change)
            self._follow(span, slope)
            if span < ramp:
                self.flux_density += slope * span * unit
                return
            left -= span
        self.flux_density = self.schedule.current
        if left > 0.0:
            self._follow(left, 0.0)

    def _follow(self, duration: float, slope: float) -> None:
        material = self._material
        status, stretch, rate, _, _, step = kernels.advance(
            self._work, self.stretch, self._rate, 0.0, 0.0,
            self.flux_density / self.actuator.flux_density_unit, slope, 0.0, 0.0, duration,
            material.zeta, material.c1, 1.0 / material.j_lim, RTOL, self._step)
        if status != kernels.DONE:
            raise HmsaError(
                f'the integration stopped at {self.time} ns under {self.flux_density:g} T: the '
                'load is too large to follow')
        self.stretch, self._rate, self._step = stretch, rate, step

    def equilibrium(self) -> float:
        """
        Return the stretch at which the flux density in force would hold the actuator.

        Returns
        -------
        float
            Stretch.

        """
        return float(equilibrium_stretch(
            self.flux_density / self.actuator.flux_density_unit, self._material.j_lim))


def unshaped(
        targets: Sequence[float], begins: Sequence[float], times: ArrayLike,
        material: NondimensionalParameters, *, start: float = 1.0) -> tuple[Array, Array]:
    """
    Sample the response to plain steps, the paper's unshaped input.

    Parameters
    ----------
    targets : sequence of float
        Stretches whose holding load is applied.
    begins : sequence of float
        Times at which each step begins.
    times : array_like, shape (n,)
        Times to sample at.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    start : float
        Stretch at rest before the first step.

    Returns
    -------
    stretch, rate : ndarray, shape (n,)
        Samples.

    Raises
    ------
    BadInputError
        If a stretch or the times are out of range.

    """
    for target in targets:
        check_stretch(target, material.j_lim, 'target')
    loads = [kernels.elastic_force(float(x), 1.0 / material.j_lim) for x in targets]
    return simulate(begins, loads, times, material, stretch=start)
