"""Result of an identification, as a frozen record."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
import math
from typing import Any, Literal

from hmsa.identification.fit import Fit, Whiteness
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import actuator_of, modulus_of
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.table import Column, Table

IdentificationVerdict = Literal['identified', 'not_identifiable', 'model_rejected']
#: Correlation from which two parameters count as confounded.
CONFOUNDED = 0.95
#: Maximum error of the model, relative to a step, that may be accepted.
ACCEPTABLE = 0.05


@dataclass(frozen=True)
class Estimate:
    """
    One parameter.

    Attributes
    ----------
    value, std : float
        Value and standard deviation in SI units; NaN if undetermined; ``std`` is 0 for a parameter
        that was not free.
    low, high : float
        Ends of the 95 % interval, which also includes undetectable errors, such as an unknown
        gain of the sensor.
    unit : str
        In plain text.
    free : bool
        Whether it was estimated.

    """

    value: float
    std: float
    low: float
    high: float
    unit: str
    free: bool


@dataclass(frozen=True)
class Defect:
    """
    A departure from the model, tested on the residuals.

    Attributes
    ----------
    name : str
        Description.
    share : float
        Fraction of the residuals' sum of squares that it explains, 0 to 1.
    deviations : float
        Its size in standard deviations.
    found : bool
        Whether it is significant.
    remedy : str
        Parameters to free for it; empty if there are none.

    """

    name: str
    share: float
    deviations: float
    found: bool
    remedy: str = ''


@dataclass(frozen=True)
class Mode:
    """
    A secondary mode that a recording shows.

    Attributes
    ----------
    frequency : float
        In Hz, about rest without field.
    ratio, share : tuple of float
        Its frequency relative to that of the first mode, and its share of the static stretch, each
        with the ends of the 95 % interval.
    damping_ratio : float
        Its damping ratio.
    number : int
        2 for the first of them, by frequency.

    """

    frequency: float
    ratio: tuple[float, float, float]
    share: tuple[float, float, float]
    damping_ratio: float
    number: int = 2

    @property
    def words(self) -> str:
        """Description."""
        value, low, high = self.ratio
        share, least, most = (100.0 * x for x in self.share)
        ends = f', {low:.3g} to {high:.3g}' if high > low else ''
        return (
            f'{"a second mode" if self.number == 2 else f"mode {self.number}"} at '
            f'{self.frequency:.4g} Hz ({value:.3g} times the first{ends}) with a share of '
            f'{share:.3g} % ({least:.2g} to {most:.2g} %)')


@dataclass(frozen=True, eq=False)
class Identification:
    """
    Parameters from a recording, with their uncertainty and a verdict.

    Attributes
    ----------
    verdict : str
        ``identified``, ``not_identifiable`` or ``model_rejected``.
    reason : str
        Reason for the verdict.
    warnings : tuple of str
        Further information for the reader.
    parameters : dict of str to Estimate
        Parameters by name; undetermined values are NaN.
    names : tuple of str
        Free parameters, in the order of the covariance.
    covariance : ndarray, shape (p, p)
        Covariance of their values in SI units; NaN if undetermined.
    noise_std : float
        Standard deviation of a sample.
    residual_rms : float
        RMS of all residuals, including outliers.
    samples, outliers : int
        Number of samples, and number of those with zero weight.
    recording : Recording
        The measured data.
    fit : Fit
        The optimum: simulated stretch, residuals, and weight of each sample.
    whiteness : Whiteness
        Of the residuals.
    signatures : tuple of Signature
        Departures tested on the residuals.
    widened : float
        Largest factor by which correlation widened a standard deviation.
    values : dict of str to object
        Values of all quantities, and the model, at the optimum, for any verdict.
    starts, agreed : int
        Number of start values, and number of those that converged to this optimum.
    cost : float
        Peak-to-peak error of the model relative to a step; 0 if none is significant.

    """

    verdict: IdentificationVerdict
    reason: str
    warnings: tuple[str, ...]
    parameters: dict[str, Estimate]
    names: tuple[str, ...]
    covariance: Array
    noise_std: float
    residual_rms: float
    samples: int
    outliers: int
    recording: Measurement
    fit: Fit
    whiteness: Whiteness
    signatures: tuple[Defect, ...]
    widened: float
    values: Mapping[str, Any]
    starts: int
    agreed: int
    cost: float
    modes: tuple[Mode, ...] = ()

    @property
    def actuator(self) -> ActuatorParameters:
        """The block at the optimum; use it only if the verdict is ``identified``."""
        return actuator_of(self.values)

    @property
    def acceptable(self) -> bool:
        """Whether the error of the model is small enough for plans."""
        return (
            self.verdict == 'model_rejected' and 0.0 < self.cost <= ACCEPTABLE
            and all(math.isfinite(self.parameters[x].std) for x in self.names))

    def shown(self, name: str) -> tuple[str, Estimate]:
        """Return a parameter under its usual name: the modulus of a beam is Young's."""
        label, ratio = modulus_of(self.values.get('law'))
        found = self.parameters[name]
        if name != 'shear_modulus' or label == name:
            return name, found
        return label, replace(
            found, value=ratio * found.value, std=ratio * found.std, low=ratio * found.low,
            high=ratio * found.high)

    @property
    def correlation(self) -> Array:
        """Correlation of the free parameters, shape (p, p)."""
        size = self.covariance.diagonal() ** 0.5
        found: Array = self.covariance / size[:, None] / size[None, :]
        return found

    def confounded(self) -> list[tuple[str, str, float]]:
        """Return pairs of parameters that the data hardly distinguish, with their correlation."""
        matrix = self.correlation
        names = [self.shown(x)[0] for x in self.names]
        return [
            (names[i], names[j], float(matrix[i, j]))
            for i in range(len(names)) for j in range(i)
            if abs(matrix[i, j]) >= CONFOUNDED]

    def report(self) -> Table:
        """Return a table of the free parameters with standard deviations and 95 % intervals."""
        rows = []
        for key in self.names:
            name, x = self.shown(key)
            known = x.value == x.value
            rows.append((
                name, x.value, x.std,
                f'{x.low:.6g} to {x.high:.6g}' if known else 'not identifiable', x.unit))
        confounded = self.confounded() if self.verdict == 'identified' else []
        return Table((
            Column('parameter'), Column('value', '', '.7g'), Column('std', '', '.2g'),
            Column('95 % interval'), Column('unit')), tuple(rows),
            f'noise {self.noise_std:.3g}, residual rms {self.residual_rms:.3g} of '
            f'{self.recording.coordinate.name}, {self.samples} samples', (
                *(f'{one} and {other} are confounded: correlation {x:.3f}'
                  for one, other, x in confounded), *self.warnings))

    def record(self) -> dict[str, Any]:
        """Return the output of ``hmsa identify --json``, with NaN for its null."""
        parameters = dict([self.shown('shear_modulus')]) | self.parameters
        return {
            'verdict': self.verdict, 'reason': self.reason, 'warnings': list(self.warnings),
            'parameters': {
                name: asdict(x) for name, x in parameters.items()},
            'names': list(self.names), 'covariance': self.covariance.tolist(),
            'noise_std': self.noise_std, 'samples': self.samples,
            'residual_rms': self.residual_rms, 'outliers': self.outliers,
            'whiteness': {
                'lag_one': float(self.whiteness.autocorrelation[1]),
                'p_value': self.whiteness.p_value},
            'signatures': [asdict(x) for x in self.signatures],
            'modes': [asdict(x) for x in self.modes],
            'starts': self.starts, 'agreed': self.agreed, 'cost': self.cost}
