"""What an identification has found, as one frozen record."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
import math
from typing import Any, Literal

from hmsa_ros.identification.fit import Fit
from hmsa_ros.identification.noise import Whiteness
from hmsa_ros.identification.quantities import actuator_of, modulus_of
from hmsa_ros.identification.recording import Recording
from hmsa_ros.model.equations import Array
from hmsa_ros.model.parameters import ActuatorParameters
from hmsa_ros.table import Column, Table

Verdict = Literal['identified', 'not_identifiable', 'model_rejected']
#: Correlation from which two parameters count as confounded.
CONFOUNDED = 0.95
#: Share of a step up to which what a model lacks may be accepted.
ACCEPTABLE = 0.05


@dataclass(frozen=True)
class Estimate:
    """
    One parameter.

    Attributes
    ----------
    value, std : float
        Value and standard deviation in SI; NaN where the data do not hold it; ``std`` is 0 for
        one that was not free.
    low, high : float
        Ends of the 95 % interval, which also holds what does not show in the samples, such as
        a gain of the sensor that nobody gave.
    unit : str
        In plain text.
    free : bool
        Whether it was sought.

    """

    value: float
    std: float
    low: float
    high: float
    unit: str
    free: bool


@dataclass(frozen=True)
class Signature:
    """
    Something that the model leaves out, looked for in the residuals.

    Attributes
    ----------
    name : str
        What it is.
    share : float
        Share of the residuals' sum of squares that it explains, 0 to 1.
    deviations : float
        Its size in standard deviations.
    found : bool
        Whether it is there.
    remedy : str
        What to add to the free parameters for it; empty if there is nothing.

    """

    name: str
    share: float
    deviations: float
    found: bool
    remedy: str = ''


@dataclass(frozen=True, eq=False)
class Identification:
    """
    Parameters out of a recording, and how far they can be trusted.

    Attributes
    ----------
    verdict : str
        ``identified``, ``not_identifiable`` or ``model_rejected``.
    reason : str
        Why, in sentences.
    warnings : tuple of str
        What else a reader should know.
    parameters : dict of str to Estimate
        By name; numbers that the data do not hold are NaN.
    names : tuple of str
        Free parameters, in the order of the covariance.
    covariance : ndarray, shape (p, p)
        Of their values in SI; NaN where the data do not hold them.
    noise_std : float
        Standard deviation of a sample.
    residual_rms : float
        Of all residuals, outliers included.
    samples, outliers : int
        How many samples there are, and how many of them did not count.
    recording : Recording
        What was measured.
    fit : Fit
        The optimum: simulated stretch, residuals, and how far each sample counted.
    whiteness : Whiteness
        Of the residuals.
    signatures : tuple of Signature
        What was looked for in the residuals.
    widened : float
        Largest factor by which correlation widened a deviation.
    values : dict of str to object
        Of all quantities, and the law, at the optimum, whatever the verdict.
    starts, agreed : int
        Start values that were tried, and how many of them ended at this optimum.
    cost : float
        What the model lacks of the motion, peak to peak, over a step; 0 if nothing shows.

    """

    verdict: Verdict
    reason: str
    warnings: tuple[str, ...]
    parameters: dict[str, Estimate]
    names: tuple[str, ...]
    covariance: Array
    noise_std: float
    residual_rms: float
    samples: int
    outliers: int
    recording: Recording
    fit: Fit
    whiteness: Whiteness
    signatures: tuple[Signature, ...]
    widened: float
    values: Mapping[str, Any]
    starts: int
    agreed: int
    cost: float

    @property
    def actuator(self) -> ActuatorParameters:
        """The block at the optimum; trust it only if the verdict is ``identified``."""
        return actuator_of(self.values)

    @property
    def acceptable(self) -> bool:
        """Whether what the model lacks is small enough to plan with."""
        return (
            self.verdict == 'model_rejected' and 0.0 < self.cost <= ACCEPTABLE
            and all(math.isfinite(self.parameters[x].std) for x in self.names))

    def shown(self, name: str) -> tuple[str, Estimate]:
        """Return a parameter as readers know it: the modulus of a beam is Young's."""
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
        """Return the free parameters with their deviations and 95 % intervals."""
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
        """Return what ``hmsa identify --json`` prints, with NaN where that has null."""
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
            'starts': self.starts, 'agreed': self.agreed, 'cost': self.cost}
