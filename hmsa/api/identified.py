"""Identification of an actuator from samples and commands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
import math
import os
from pathlib import Path
from typing import Any

from hmsa.api.actuator import Actuator
from hmsa.api.arguments import columns_of, file_of, mapping_of, names_of, number, suggesting
from hmsa.api.motion import Motion
from hmsa.errors import BadInputError, excerpt
from hmsa.files import may_be_bag, write_text
from hmsa.identification.files import Belief, belief_in, file_text
from hmsa.identification.identify import identify as find
from hmsa.identification.measurement import joined, Measurement, read_csv, recording_of
from hmsa.identification.quantities import free_of, Known
from hmsa.identification.result import Identification
from hmsa.model.thermal import checked_temperature
from hmsa.runs.bags import read_run
from hmsa.table import Table


@dataclass(frozen=True, eq=False)
class Identified:
    """
    Result of an identification; `identify` returns it.

    Attributes
    ----------
    result : Identification
        The complete result: values, covariance, fit residuals and verdict.
    actuator : Actuator
        The actuator with these values and the given coil; use it only if the verdict is
        ``identified``. If no actuator can have the values of a rejected fit, that of the start.

    Examples
    --------
    >>> import hmsa
    >>> levels = [(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)]
    >>> motion = hmsa.Actuator().simulate(levels, until=0.7, noise=1e-4)
    >>> found = hmsa.identify(motion, free=['remanence', 'stretch_bias'])
    >>> low, high = found.intervals['remanence']
    >>> low < 0.1 < high
    True

    """

    result: Identification
    actuator: Actuator
    _text: str  # of the parameter file

    @property
    def verdict(self) -> str:
        """``identified``, ``not_identifiable`` or ``model_rejected``."""
        return self.result.verdict

    @property
    def reason(self) -> str:
        """Reason for the verdict."""
        return self.result.reason

    @property
    def values(self) -> dict[str, float]:
        """Values of the free parameters in SI units, by name."""
        return {x: self.result.parameters[x].value for x in self.result.names}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals of the free parameters, by name."""
        found = self.result.parameters
        return {x: (found[x].low, found[x].high) for x in self.result.names}

    def report(self, path: str | Path | None = None) -> Table:
        """
        Return the table of ``hmsa identify``.

        With a path, also write the HTML page there; raise `BadInputError` if it cannot be written.

        Examples
        --------
        >>> import hmsa
        >>> levels = [(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)]
        >>> motion = hmsa.Actuator().simulate(levels, until=0.7, noise=1e-4)
        >>> found = hmsa.identify(motion, free=['remanence', 'stretch_bias'])
        >>> found.report()['parameter']
        ['remanence', 'stretch_bias']

        """
        if path is not None:
            from hmsa.report.identified import page

            write_text(file_of(path), page(self.result))
        return self.result.report()

    def to_yaml(self, path: str | Path) -> None:
        """
        Write the parameter file with the covariance, as ``hmsa identify --out`` does.

        Raises
        ------
        BadInputError
            If the verdict is not ``identified``, or the file cannot be written.

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import hmsa
        >>> levels = [(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)]
        >>> motion = hmsa.Actuator().simulate(levels, until=0.7, noise=1e-4)
        >>> found = hmsa.identify(motion, free=['remanence', 'stretch_bias'])
        >>> with TemporaryDirectory() as folder:
        ...     found.to_yaml(Path(folder, 'actuator.yaml'))
        ...     hmsa.Actuator.from_yaml(Path(folder, 'actuator.yaml')) == found.actuator
        True

        """
        if self.verdict != 'identified':
            raise BadInputError(
                f'{path} was not written: the verdict is {self.verdict} ({self.reason})')
        write_text(file_of(path), self._text)

    def __repr__(self) -> str:
        return f'<Identified {self.verdict}: {self.reason}>'

    def _repr_html_(self) -> str:
        return self.report()._repr_html_()


@suggesting
def identify(
        samples: Any, commands: Any = None, *, actuator: Actuator | None = None,
        free: Sequence[str] | None = None, known: Mapping[str, float] | None = None,
        uncertain: Mapping[str, float] | None = None,
        temperature: float | None = None) -> Identified:
    """
    Identify the parameters of an actuator from samples of its motion.

    Parameters
    ----------
    samples : Motion, path, pairs, array of shape (n, 2), mapping or DataFrame
        Times in s and stretches, in columns ``time`` and ``stretch``; or a motion, a bag or a CSV
        file.
    commands : pairs, array of shape (m, 2), mapping, DataFrame or path, optional
        Times in s and flux densities in T from that time on, in columns ``time`` and
        ``flux_density``; a motion and a bag already contain them.
    actuator : Actuator, optional
        Known parameters, such as size, density, hyperelastic model and coil; default the example
        block.
    free : sequence of str, optional
        Names of the parameters to identify; default shear modulus, damping, J_lim, remanence and
        sensor bias.
    known, uncertain : mapping of str to float, optional
        Other known values in SI units, such as ``{'sensor_latency': 2e-3}``, and standard
        deviations of known values.
    temperature : float, optional
        Temperature of the actuator in degrees Celsius, at which the values hold; default as
        recorded, if it was.

    Returns
    -------
    Identified
        Values with 95 % intervals, or the reason why the samples cannot determine them.

    Raises
    ------
    BadInputError
        If samples, commands or names cannot be used.

    Examples
    --------
    >>> import hmsa
    >>> block = hmsa.Actuator(remanence=0.12)
    >>> levels = [(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)]
    >>> motion = block.simulate(levels, until=0.7, noise=1e-4)
    >>> found = hmsa.identify(motion, free=['remanence', 'stretch_bias'])
    >>> found.verdict, round(found.values['remanence'], 3)
    ('identified', 0.12)

    """
    if not isinstance(actuator, Actuator | None):
        raise BadInputError(f'actuator is {excerpt(actuator)}: expected an Actuator')
    known, uncertain = ({x: number(y, x) for x, y in mapping_of(
        values, what, "'sensor_latency': 2e-3").items()} for what, values in (
            ('known values', known), ('standard deviations', uncertain)))
    base = actuator or Actuator()
    block, options = base.block, base.model.options
    given: dict[str, float] = {} if actuator is None else {
        'coil_time_constant': options.coil_time_constant}
    if isinstance(samples, (str, os.PathLike)):
        samples = file_of(samples)
        if may_be_bag(samples):
            samples = Motion(read_run(samples))
    if isinstance(samples, Motion):
        if commands is not None:
            raise BadInputError(
                'commands are given with a motion that has its own: expected samples alone as '
                'pairs of time and stretch, or no commands')
        recording, block, theirs = recording_of(
            samples.run, None if actuator is None else block)
        base = actuator or samples.actuator
        if math.isfinite(recording.temperature):
            base = _at(base, recording.temperature)
            given = dict.fromkeys(given, base.model.options.coil_time_constant)
        given = {**theirs, **given}
    elif isinstance(samples, Path):
        recording = read_csv(
            samples, None if commands is None else file_of(
                commands, f'that of the commands, since samples are the file {samples}'),
            slew_limit=options.slew_limit, coordinate=block.coordinate)
    else:
        if commands is None:
            raise BadInputError(
                'commands are missing: expected times in s and flux densities in T from then on')
        time, stretch = columns_of(samples, ('time', 'stretch'), 'samples')
        times, levels = columns_of(commands, ('time', 'flux_density'), 'commands')
        notes: list[str] = []
        times, levels = joined(time, stretch, times, levels, notes)
        recording = Measurement(
            time - time[0], stretch, times - time[0], levels, options.slew_limit,
            notes=tuple(notes), coordinate=block.coordinate)
    if temperature is not None:
        celsius = checked_temperature(number(temperature, 'temperature', 'degC'))
        base, block = _at(base, celsius), block.at_temperature(celsius)
        given = dict.fromkeys(given, base.model.options.coil_time_constant)
        recording = replace(recording, temperature=celsius)
    others = {x: y for x, y in {**given, **known}.items() if y or x in known}
    names = [] if free is None else names_of(free, 'free')
    result = find(
        recording, free=free_of(','.join(names), base.block.law, known), known=others,
        actuator=None if actuator is None and not isinstance(samples, Motion) else block,
        uncertain=uncertain)
    text = file_text(
        result, Belief(result.actuator, others, base.parameters, Known()),
        recording.label, datetime.now().astimezone())
    # Only the file has all values under their names in the nodes.
    try:
        belief = belief_in(text)
        found = Actuator.from_parameters(
            belief.settings, belief if result.verdict == 'identified' else None)
    except BadInputError:  # a fit without meaning has values that no actuator has
        if result.verdict == 'identified':
            raise
        found = base
    return Identified(result, found, text)


def _at(actuator: Actuator, temperature: float) -> Actuator:
    """Return an actuator at a temperature; unchanged without coefficients."""
    return actuator.at_temperature(temperature) if actuator.block.thermal else actuator
