"""An actuator with its coil: planning, simulation and parameter files."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from hmsa.api.arguments import (
    checked,
    columns_of,
    DAMPED,
    file_of,
    grid_of,
    limits_of,
    mapping_of,
    model_of,
    number,
    numbers,
    parameters_in,
    setpoints_of,
    suggesting,
    whole,
)
from hmsa.api.facts import facts, Scales, scales, unquestioned, warn
from hmsa.errors import assume, BadInputError, check_choice, check_number, UnusualWarning
from hmsa.files import write_text, yaml_text
from hmsa.interfaces.actuator import parameters_of, planned_from
from hmsa.interfaces.parameters import (
    ACTUATOR_FIELDS,
    BLOCK,
    CREEP_TOLERANCE,
    FLUX_DENSITY_MAX,
    LAW_NAME,
    ZETA,
)
from hmsa.interfaces.topics import PLANNER, PLANT
from hmsa.model.delivery import IDEAL
from hmsa.model.equations import Array, critical_zeta, elastic_force, equilibrium_stretch
from hmsa.model.moves import Setpoint, State
from hmsa.model.parameters import ActuatorParameters, Uncertainty
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import as_errors, ERRORS, MoveRequest, SmoothLimits
from hmsa.planning.timeline import JointModel
from hmsa.runs.parameters import assume_one_joint, entries_of, read_parameter_file
from hmsa.table import Column, Table

if TYPE_CHECKING:
    from hmsa.api.motion import Motion
    from hmsa.api.plan import Plan
    from hmsa.identification.files import Belief

_STRONGEST: Any = FLUX_DENSITY_MAX.default


class Actuator:
    """
    A block of 2L x 2L x 2H of hard-magnetic elastomer, or a beam, with its coil; all in SI units.

    Here and in all methods, quantities of pint are accepted as well as numbers, and converted.

    Parameters
    ----------
    shear_modulus : float, optional
        G in Pa; default 10 kPa. If the constants of the model include moduli, they determine G.
    density : float
        rho in kg/m^3.
    half_length : float
        L in m, across the field.
    half_thickness : float, optional
        H in m, along the field; default the half length.
    remanence : float
        Residual flux density Br in T.
    chain_limit : float
        J_lim of the Gent model; infinite for neo-Hookean.
    zeta, damping_ratio, damping_coefficient : float, optional
        Damping, one of: the paper's c/(8 L H sqrt(rho G)); the fraction of critical damping at
        rest, from the ringing; c in N s/m. Default zeta 0.2. The ratio is zeta over the critical
        zeta, which is 2.449 for a cube, so that zeta 0.1 is a ratio of 0.041.
    law : str
        Name of the hyperelastic model, a key of `hmsa.model.laws.LAWS`, such as ``'yeoh'``.
    constants : mapping of str, optional
        Constants of the model in SI units, such as ``{'c10': 5e3, 'c20': 200.0, 'c30': 0.0}``.
    creep : sequence of (float, float)
        Viscoelastic branches: stiffness relative to the model's, and relaxation time in s.
    bulk_ratio : float
        Bulk over shear modulus of a compressible block, 1 to 1e6; infinite for constant volume.
    flux_density_limits : float or (float, float)
        Limits of the coil in T; one number for both directions.
    slew_limit : float
        Slew rate of the amplifier in T/s; infinite for ideal steps.
    coil_time_constant : float
        L/R of the coil in s; 0 for none.
    mount : {'paper', 'free', 'glued'}
        The paper's block, which deforms uniformly, also in motion; or a continuum with its modes
        (`hmsa.model.continuum`), free or with one face glued to a rigid support. The shaper
        ``'modal'`` brings all modes to rest. ``'clamped'`` is for a beam, see `beam`.
    thermal : mapping of str to float, optional
        Temperature coefficients in 1/K of ``shear_modulus``, ``remanence``,
        ``damping_coefficient`` and ``coil_resistance``, and the ``reference`` in degrees Celsius
        at which all values hold (default 25), as the parameters ``thermal.*``; default no effect
        of the temperature.

    Raises
    ------
    BadInputError
        If a value has the wrong type or is out of range.

    Warns
    -----
    UnusualWarning
        If a value is possible but unusual; ``hmsa init`` says the same.

    Examples
    --------
    >>> from hmsa import Actuator
    >>> block = Actuator(shear_modulus=30e3, half_length=5e-3, remanence=0.08, zeta=0.1)
    >>> round(block.damping_ratio, 3)
    0.041
    >>> round(1e3 * block.flux_density(1.1), 1)   # mT that hold a stretch of 1.1
    129.6
    >>> silicone = Actuator(law='yeoh', constants={'c10': 15e3, 'c20': 500.0, 'c30': 20.0})
    >>> silicone.shear_modulus
    30000.0

    """

    @suggesting
    def __init__(
            self, *, shear_modulus: float | None = None, density: float = 1900.0,
            half_length: float = 0.01, half_thickness: float | None = None,
            remanence: float = 0.1, chain_limit: float = 5.0, zeta: float | None = None,
            damping_ratio: float | None = None, damping_coefficient: float | None = None,
            law: str = 'gent', constants: Mapping[str, Any] | None = None,
            creep: Sequence[tuple[float, float]] = (), bulk_ratio: float = math.inf,
            flux_density_limits: float | tuple[float, float] = _STRONGEST,
            slew_limit: float = math.inf, coil_time_constant: float = 0.0,
            mount: str = 'paper', thermal: Mapping[str, float] | None = None) -> None:
        given = {
            **locals(),
            'half_thickness': half_length if half_thickness is None else half_thickness}
        if all(given[x] is None for x in DAMPED):
            zeta = ZETA
        #: Parameters that plans are made with.
        self.model = model_of(parameters_in(given), zeta, damping_ratio, mount)
        self._belief: Belief | Path | None = None
        warn(self, mount)

    @classmethod
    def from_parameters(
            cls, values: Mapping[str, Any], belief: 'Belief | Path | None' = None) -> 'Actuator':
        """
        Return the actuator with node parameters, such as ``{'actuator.remanence': 0.1}``.

        Missing parameters take their defaults. ``belief`` is their uncertainty, if known, or the
        file that contains it. Raise `BadInputError` if a value has the wrong type or is out of
        range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator.from_parameters({'actuator.shear_modulus': 30e3}).shear_modulus
        30000.0

        """
        return cls._of(
            model_of(mapping_of(values, 'parameters', "'actuator.remanence': 0.1")), belief)

    @classmethod
    def _of(cls, model: JointModel, belief: 'Belief | Path | None' = None) -> 'Actuator':
        made = cls.__new__(cls)
        made.model, made._belief = model, belief
        return made

    @classmethod
    def from_yaml(cls, path: str | Path) -> 'Actuator':
        """
        Return the actuator of a parameter file written by ``hmsa init`` or ``hmsa identify``.

        Raises
        ------
        BadInputError
            If the file cannot be read, or a value in it is out of range.

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from hmsa import Actuator
        >>> block = Actuator(shear_modulus=30e3)
        >>> with TemporaryDirectory() as folder:
        ...     block.to_yaml(Path(folder, 'actuator.yaml'))
        ...     Actuator.from_yaml(Path(folder, 'actuator.yaml')) == block
        True

        """
        path = file_of(path, 'the path of a YAML file')
        entries = entries_of(path)
        assume_one_joint(path, entries)
        values = {name.partition('.')[2]: value
                  for name, value in read_parameter_file(path, entries).items()
                  if name.startswith(f'{PLANNER}.')}
        blocks = {x.name for x in BLOCK}
        if alone := [x for node, x, _ in entries
                     if node == PLANT and x in blocks and x not in values]:
            assume(
                f'{path}: its section {PLANT} alone sets {", ".join(alone)}: plans use the '
                f'parameters of {PLANNER} or of all nodes (/**), or else the defaults')
        made = cls.from_parameters(values, path)
        warn(made)
        return made

    @classmethod
    def beam(
            cls, *, length: float, thickness: float, width: float, youngs_modulus: float,
            damping_ratio: float | None = None, damping_coefficient: float | None = None,
            mount: str = 'paper', **more: Any) -> 'Actuator':
        """
        Return a beam, clamped at one end and magnetised along its length.

        Positions are tip deflections divided by the length.

        Parameters
        ----------
        length, thickness, width : float
            In m; the field is along the thickness.
        youngs_modulus : float
            E in Pa.
        damping_ratio, damping_coefficient : float, optional
            Damping ratio of the first mode, or c of the tip in N s/m; default a ratio of 0.05.
        mount : {'paper', 'clamped'}
            A beam in the shape of its first mode; or along its elastica, which is exact at rest,
            with its second mode, which the shaper ``'modal'`` brings to rest, too.
        **more
            Density, remanence, creep and coil parameters of `Actuator`.

        Returns
        -------
        Actuator
            The beam; its `law` is ``'beam'``.

        Raises
        ------
        BadInputError
            If a value has the wrong type or is out of range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> strip = Actuator.beam(length=10e-3, thickness=1e-3, width=5e-3, youngs_modulus=2e6)
        >>> strip.plan([(0.1, 0.5)]).report()['status']
        ['two_step']
        >>> strip = Actuator.beam(
        ...     length=10e-3, thickness=1e-3, width=5e-3, youngs_modulus=2e6, mount='clamped')
        >>> strip.plan([(0.3, 0.5), (-0.1, 0.5)], 'modal').report()['status']
        ['modal', 'modal']

        """
        if damping_ratio is None and damping_coefficient is None:
            damping_ratio = 0.05
        with unquestioned():
            made = cls(**{
                'mount': mount, 'damping_ratio': damping_ratio,
                'damping_coefficient': damping_coefficient,
                'half_length': 0.5 * number(length, 'length', 'm'),
                'half_thickness': 0.5 * number(thickness, 'thickness', 'm'), 'law': 'beam',
                'constants': {'youngs_modulus': youngs_modulus, 'width': width}, **more})
        warn(made)
        return made

    # -- properties ----------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters, by their names in the nodes."""
        actuator, options = self.block, self.model.options
        return parameters_of(actuator) | actuator.creep.parameters | {
            'flux_density_min': options.flux_density_min,
            'flux_density_max': options.flux_density_max,
            'slew_limit': 0.0 if math.isinf(options.slew_limit) else options.slew_limit,
            'coil_time_constant': options.coil_time_constant,
            # Written only if it was given: nodes have another default (`models`).
            **({} if options.creep_tolerance == IDEAL.ripple else {
                CREEP_TOLERANCE.name: options.creep_tolerance})}

    @property
    def block(self) -> ActuatorParameters:
        """Parameters of the block alone."""
        return self.model.actuator

    @property
    def shear_modulus(self) -> float:
        """G in Pa at small strain."""
        return self.block.shear_modulus

    @property
    def zeta(self) -> float:
        """Dimensionless damping."""
        return self.model.material.zeta

    @property
    def damping_ratio(self) -> float:
        """Fraction of critical damping, of small motion about rest: zeta over critical zeta."""
        material = self.model.material
        return material.zeta / float(critical_zeta(material.rest, material))

    @property
    def law(self) -> str:
        """Name of the hyperelastic model."""
        return 'gent' if self.block.law is None else self.block.law.law

    @property
    def flux_density_limits(self) -> tuple[float, float]:
        """Limits of the coil in T."""
        return self.model.options.flux_density_min, self.model.options.flux_density_max

    @cached_property
    def scales(self) -> Scales:
        """Derived quantities: times in s, flux densities in T, and reachable stretches."""
        return scales(self.block, *self.flux_density_limits)

    def flux_density(self, stretch: ArrayLike) -> Any:
        """
        Return the flux densities in T that hold stretches; a number or an array.

        Raise `BadInputError` if the stretches are no numbers or beyond the limits of the model.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().flux_density([1.0, 1.1]).round(4).tolist()
        [0.0, 0.0346]

        """
        material, values = self.model.material, numbers(stretch, 'stretches')
        lower, upper = material.limits
        for outside in values[~((lower < values) & (values < upper))].tolist():
            material.check(outside)
        found = self.model.units.level(elastic_force(values, material))
        return found if np.ndim(found) else float(found)

    def stretch(self, flux_density: ArrayLike) -> Any:
        """
        Return the equilibrium stretches at flux densities in T; a number or an array.

        Raise `BadInputError` if the flux densities are no finite numbers.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().stretch([0.0, 0.02]).round(4).tolist()
        [1.0, 1.0559]

        """
        values = numbers(flux_density, 'flux densities', unit='T')
        for wrong in values[~np.isfinite(values)].tolist():
            check_number('flux density', wrong, 'T')
        found = equilibrium_stretch(self.model.units.of_level(values), self.model.material)
        return found if np.ndim(found) else float(found)

    def report(self) -> Table:
        """
        Return a table of the derived quantities.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().report()[1]
        {'quantity': 'natural frequency at rest', 'value': '89.437 Hz'}

        """
        return Table(
            (Column('quantity'), Column('value')), tuple(facts(self.scales, self.block)))

    def __repr__(self) -> str:
        size = ' x '.join(f'{2e3 * x:.4g}' for x in (
            self.block.half_length, self.block.half_thickness))
        return (
            f'<Actuator {self.law}: {size} mm, shear modulus {1e-3 * self.shear_modulus:.4g} kPa, '
            f'{self.scales.frequency:.4g} Hz, damping ratio {self.damping_ratio:.3g}>')

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Actuator) and self.model == other.model

    def __hash__(self) -> int:
        return hash(self.model)

    def _repr_html_(self) -> str:
        return self.report()._repr_html_()

    # -- variants ------------------------------------------------------------------------------

    def replace(self, **parameters: Any) -> 'Actuator':
        """
        Return a copy of the actuator with some parameters replaced.

        Parameters
        ----------
        **parameters
            As for `Actuator`; zeta stays unless damping is given, and modes stay. A mount may be
            given to a block of the paper.

        Returns
        -------
        Actuator
            A copy in which all other parameters are unchanged.

        Raises
        ------
        BadInputError
            If a name is unknown, or a value has the wrong type or is out of range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().replace(slew_limit=50.0).parameters['slew_limit']
        50.0

        """
        for name in parameters:
            check_choice('a parameter to replace', name, _KEYS)
        changed = parameters_in(parameters, self.law)
        # A new model, new branches or coefficients replace all previous ones.
        groups = ('law',) * (changed[LAW_NAME.name] != self.law) + (
            'viscoelastic',) * ('creep' in parameters) + (
            'thermal',) * ('thermal' in parameters)
        zeta = self.zeta if parameters.get('zeta') is None else parameters['zeta']
        made = self._of(model_of(
            {x: y for x, y in self.parameters.items()
             if x.partition('.')[0] not in groups} | changed,
            None if 'actuator.damping_coefficient' in changed else zeta,
            parameters.get('damping_ratio'), parameters.get('mount', 'paper')))
        warn(made, parameters.get('mount', 'paper'))
        return made

    def scaled(self, **factors: float) -> 'Actuator':
        """
        Return a copy of the actuator with some parameters multiplied by factors.

        Parameters
        ----------
        **factors
            Factors above 0 on `shear_modulus`, `density`, `half_length`, `half_thickness`,
            `remanence`, `chain_limit` and `damping_coefficient`. A factor on the shear modulus
            multiplies all moduli of the hyperelastic model.

        Returns
        -------
        Actuator
            A copy in which all other parameters are unchanged.

        Raises
        ------
        BadInputError
            If a name is unknown, or a factor is out of range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().scaled(shear_modulus=1.2).shear_modulus
        12000.0

        """
        for name in factors:
            check_choice('a parameter to scale', name, ACTUATOR_FIELDS)
        return self._of(JointModel(planned_from(checked(self.parameters) | {
            f'mismatch.{name}': number(x, f'the factor on {name}')
            for name, x in factors.items()}), self.model.options))

    def at_temperature(self, temperature: float) -> 'Actuator':
        """
        Return the actuator at a temperature, with ordinary parameters that hold there.

        Parameters
        ----------
        temperature : float
            Of block and coil, in degrees Celsius.

        Returns
        -------
        Actuator
            The same actuator with this temperature as the reference.

        Raises
        ------
        BadInputError
            If the actuator has no temperature coefficients, or for an impossible temperature.

        Warns
        -----
        UnusualWarning
            If the magnets may lose remanence permanently.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> block = Actuator(thermal={'shear_modulus': 3e-3, 'remanence': -1e-3})
        >>> warm = block.at_temperature(40.0)
        >>> round(warm.shear_modulus), round(1e3 * warm.flux_density(1.1), 2)
        (10450, 36.68)

        """
        thermal, value = self.block.thermal, number(temperature, 'temperature', 'degC')
        if not thermal:
            raise BadInputError(
                f'temperature is {value:g}, and the actuator has no temperature coefficients: '
                "expected some, such as thermal={'shear_modulus': 3e-3, 'remanence': -1e-3}, or "
                'thermal.* in the parameter file')
        made = self._of(self.model.at_temperature(value), self._belief)
        if words := thermal.warning(value):
            assume(words, UnusualWarning)
        return made

    # -- plans and motions ---------------------------------------------------------------------

    @suggesting
    def plan(
            self, setpoints: Any, shaper: str = 'two_step', *,
            limits: float | tuple[float, float] | None = None, start: float | None = None,
            order: int = 2, errors: Sequence[float] | None = None, periods: float = 1.0,
            max_rate: float = math.inf, period: float = 0.0,
            short_spell: str = 'refuse', temperature: float | None = None) -> 'Plan':
        """
        Plan a command without residual vibration.

        Parameters
        ----------
        setpoints : pairs, array of shape (n, 2), mapping or DataFrame
            Stretch, or deflection of a beam, and duration in s (move and dwell) of each setpoint;
            columns are named ``stretch`` and ``duration``.
        shaper : str
            A key of `hmsa.planning.shapers.SHAPERS`.
        limits : float or (float, float), optional
            Limits of the flux density in T; default those of the coil.
        start : float, optional
            Initial stretch, at rest; default that without a field.
        order : int
            Order of the shapers robust and minimax, 1 to 16.
        errors : (float, float, float), optional
            Relative errors of shear modulus, damping and J_lim that minimax must tolerate; default
            those of the parameter file, else 0.1 each.
        periods, max_rate : float
            For smooth: minimum duration of a move in natural periods, and maximum rate in 1/s.
        period : float
            Of the command grid in s; 0 for any time.
        short_spell : {'refuse', 'continue'}
            How to treat a duration that is shorter than the move.
        temperature : float, optional
            Temperature of the actuator in degrees Celsius, see `at_temperature`; default that at
            which its parameters hold.

        Returns
        -------
        Plan
            Times and levels, and the predicted motion.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.
        RefusedError
            If a setpoint cannot be reached; the message gives the reason.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> plan = Actuator().plan([(1.1, 0.5), (1.0, 0.5)], limits=0.5)
        >>> plan.times.round(6).tolist()
        [0.0, 0.005735, 0.5, 0.505733]
        >>> plan.flux_densities.round(6).tolist()
        [0.020118, 0.034571, 0.015396, 0.0]

        """
        from hmsa.api.plan import Plan

        actuator = self if temperature is None else self.at_temperature(temperature)
        model, shape = actuator.model, get_shaper(shaper)
        stretches, durations = setpoints_of(setpoints, model.material.rest)
        order, rate = whole(order, 'order'), number(max_rate, 'max_rate', '1/s')
        if limits is not None:
            low, high = limits_of(limits)
            model = JointModel(model.actuator, replace(
                model.options, flux_density_min=low, flux_density_max=high))
        unit = model.units.time
        segments = plan_sequence(
            [Setpoint(x, y / unit) for x, y in zip(
                stretches.tolist(), durations.tolist(), strict=True)],
            MoveRequest.of(
                model.material,
                State(model.material.rest if start is None else number(start, 'start')),
                limits=model.limits, units=model.units, order=order,
                delivery=replace(model.delivery, period=grid_of(period) / unit),
                errors=actuator._errors(shaper) if errors is None else as_errors(errors),
                pace=SmoothLimits(
                    number(periods, 'periods'), unit * (rate if rate == math.inf else number(
                    rate, 'max_rate', '1/s', above=0.0)))),
            shape, short_spell)
        return Plan(actuator, segments, shaper)

    @suggesting
    def follow(
            self, times: ArrayLike, stretches: ArrayLike, rates: ArrayLike | None = None,
            accelerations: ArrayLike | None = None, *, tolerance: float = 1e-6,
            period: float = 0.0) -> 'Plan':
        """
        Plan a command that follows a path from rest to rest.

        Parameters
        ----------
        times : array_like, shape (n,)
            In s, increasing, at least two.
        stretches : array_like, shape (n,)
            Stretches at these times; the actuator is at rest at the first.
        rates, accelerations : array_like, shape (n,), optional
            In 1/s and 1/s^2; the last rate is 0. The path is a Hermite spline through all given
            columns, or the smoothest spline through the stretches alone.
        tolerance : float
            Deviation that the levels may leave, as a fraction of the range of the path.
        period : float
            Of the command grid in s; 0 for any time.

        Returns
        -------
        Plan
            One segment, whose notes contain the maximum deviation if limits keep the actuator from
            the path.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.
        RefusedError
            If the path leaves the stretches that the hyperelastic model allows.

        Examples
        --------
        >>> import numpy as np
        >>> from hmsa import Actuator
        >>> times = np.linspace(0.0, 0.5, 11)
        >>> plan = Actuator().follow(times, 1.0 + 0.1 * np.sin(np.pi * times / 0.5) ** 2)
        >>> plan.segments[0].notes()
        []

        """
        from hmsa.api.paths import followed, path_of

        path = path_of(self, (times, stretches, rates, accelerations))
        ends = numbers(stretches, 'stretches')[[0, -1]].tolist()
        return followed(self, path, (ends[0], ends[1]), tolerance, period)

    @suggesting
    def wave(
            self, shape: Any, frequency: float, amplitude: float, *, offset: float | None = None,
            cycles: float = 10.0, last: float | None = None, tolerance: float = 1e-4) -> 'Plan':
        """
        Plan a periodic motion of the stretch that starts and ends at rest without a field.

        Parameters
        ----------
        shape : {'sine', 'triangle', 'square'} or pairs, array of shape (n, 2), mapping, DataFrame
            Shape of the stretch (not of the field), or one period of times and stretches, shifted
            and scaled so that the mean is the offset, and the peak the amplitude. A square wave is
            a sequence of two-step moves.
        frequency : float
            In Hz.
        amplitude : float
            Amplitude of the stretch about the offset.
        offset : float, optional
            Mean stretch; default that without a field.
        cycles : float
            Cycles at full amplitude, in addition to those that fade in and out.
        last : float, optional
            Frequency in Hz at the end of a sweep; default no sweep.
        tolerance : float
            Deviation that the levels may leave, as a fraction of the range.

        Returns
        -------
        Plan
            Levels that end at rest.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.
        RefusedError
            If the limits of the coil do not allow the frequency; see `wave_bands`.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> block = Actuator()
        >>> block.wave_bands('sine', 0.05).round(1).tolist()
        [[0.0, 457.1]]
        >>> block.wave('sine', 30.0, 0.05).simulate().report()['verdict']
        ['arrived']

        """
        from hmsa.api.paths import followed, wave_of, wave_path

        wave = wave_of(self, shape, amplitude, offset)
        first, end = (number(x, 'frequency', 'Hz', above=0.0) for x in (
            frequency, frequency if last is None else last))
        if isinstance(shape, str) and shape == 'square':
            half = 0.5 / first
            count = round(number(cycles, 'cycles', least=1.0, most=1e5))
            return self.plan([(wave.mean + wave.amplitude, half), (
                wave.mean - wave.amplitude, half)] * count + [(self.block.rest, half)])
        path = wave_path(self, wave, (first, end), cycles)
        return followed(self, path, (self.block.rest,) * 2, tolerance)

    def wave_bands(self, shape: Any, amplitude: float, offset: float | None = None) -> Array:
        """
        Return the frequency bands in Hz that the limits of the coil allow, shape (n, 2).

        The arguments are those of `wave`. A band that starts at 0 has no lower limit. Raise
        `BadInputError` if the arguments describe no wave.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator(flux_density_limits=0.05).wave_bands('sine', 0.05).round(1).tolist()
        [[0.0, 167.3]]

        """
        from hmsa.api.paths import bands

        return bands(self, shape, amplitude, offset)

    def _errors(self, shaper: str) -> Uncertainty:
        """Return the default relative errors that minimax must tolerate."""
        if shaper != 'minimax' or self._belief is None:
            return ERRORS
        from hmsa.identification.files import errors_of, read_belief

        if isinstance(self._belief, Path):
            self._belief = read_belief(self._belief)
        return errors_of(self._belief, ERRORS)

    @suggesting
    def simulate(
            self, levels: Any, *, until: float | None = None, rate: float | None = None,
            noise: float = 0.0, seed: int = 0, start: float | None = None,
            label: str = 'simulated') -> 'Motion':
        """
        Simulate the response to given levels.

        Parameters
        ----------
        levels : pairs, array of shape (n, 2), mapping, DataFrame or path
            Time in s and flux density in T from that time on; columns, also in a CSV file, are
            named ``time`` and ``flux_density``.
        until : float, optional
            End in s; default after the motion has settled at the last level.
        rate : float, optional
            Sampling rate in Hz; default 1000 Hz, or 40 samples per natural period if this is more.
        noise : float
            Standard deviation of the samples of the stretch.
        seed : int
            Seed of the noise.
        start : float, optional
            Initial stretch, at rest; default that without a field.
        label : str
            Name in figures and comparisons.

        Returns
        -------
        Motion
            Samples and levels.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.
        HmsaError
            If a level is too large to follow.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> motion = Actuator().simulate([(0.0, 0.0346)], until=0.2)
        >>> round(float(motion.stretches.max()), 3)
        1.178

        """
        from hmsa.api.motion import simulated
        from hmsa.identification.measurement import read_levels

        if isinstance(levels, (str, Path)):
            times, values = read_levels(file_of(levels))
        else:
            times, values = columns_of(levels, ('time', 'flux_density'), 'levels')
        return simulated(
            self, times, values, start, until=until, rate=rate, noise=noise, seed=seed,
            label=label)

    def amplifiers(self, setpoints: Any, **more: Any) -> Table:
        """
        Compare amplifiers from fast to slow: demands of a planned sequence on each, and time lost.

        Parameters
        ----------
        setpoints : pairs, array of shape (n, 2), mapping or DataFrame
            As for `plan`.
        **more
            ``slew_limits`` in T/s and ``bandwidths`` in Hz to try, by default around those of the
            fastest move; ``inductance`` in H, ``resistance`` in ohm and ``tesla_per_ampere`` of
            the coil, for currents and voltages; ``shaper`` and other arguments of `plan`.

        Returns
        -------
        Table
            A row for each amplifier, the first with ideal steps.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> block = Actuator(shear_modulus=30e3, half_length=5e-3, remanence=0.08, zeta=0.1)
        >>> found = block.amplifiers([(1.1, 0.5)], slew_limits=[200.0, 50.0], bandwidths=[])
        >>> [round(x, 2) for x in found['longest move']]
        [1.65, 1.98, 2.97]

        """
        from hmsa.api.plan import amplifiers

        return amplifiers(self, setpoints, **more)

    def to_yaml(self, path: str | Path) -> None:
        """
        Write the parameter file that the commands and nodes take (``--params-file``).

        Raises
        ------
        BadInputError
            If the file cannot be written.

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from hmsa import Actuator
        >>> with TemporaryDirectory() as folder:
        ...     Actuator().to_yaml(Path(folder, 'actuator.yaml'))
        ...     print(Path(folder, 'actuator.yaml').read_text().splitlines()[2])
            actuator.shear_modulus: 10000.0

        """
        write_text(file_of(path), '\n'.join([
            '/**:', '  ros__parameters:',
            *(f'    {x}: {yaml_text(y)}' for x, y in self.parameters.items())]) + '\n')


_KEYS = tuple(x for x in Actuator.__init__.__annotations__ if x != 'return')
