"""Uncertainty of parameters, from an identification or feedback, for the next run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification.quantities import check_free, FACTORS
from hmsa.model.equations import Array

#: Prefix in parameter files.
PREFIX = 'identification.'
# Minimum eigenvalue of the correlation matrix.
_SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Known:
    """Values of parameters and their covariance, in SI units; empty if none were identified."""

    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()  # in the order of the names; empty if given elsewhere
    # Of shape (p, p).
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        matrix, size = self.covariance, len(self.names)
        if matrix.shape != (size, size) or not np.all(np.isfinite(matrix)):
            raise BadInputError(
                f'{PREFIX}covariance has {matrix.size} numbers for {size} names: expected '
                f'{size ** 2} finite ones')
        if len(self.values) not in (0, size):
            raise BadInputError(
                f'{PREFIX}values has {len(self.values)} numbers for {size} names: expected '
                f'{size}')
        scale = np.sqrt(np.abs(np.diag(matrix)))
        if not np.all(scale > 0.0) or size and (
                not np.allclose(matrix, matrix.T, 1e-6, 0.0)
                or np.min(np.linalg.eigvalsh(matrix / np.outer(scale, scale))) < _SINGULAR):
            raise BadInputError(
                f'{PREFIX}covariance is not a covariance matrix: expected a symmetric one with '
                'positive eigenvalues, row after row')

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> 'Known':
        """Return the values in parameters by dotted name; raise `BadInputError` if unusable."""
        names, values, flat = (
            settings.get(PREFIX + x) or [] for x in ('names', 'values', 'covariance'))
        # Constants of a model, modes, compressibility and factors of the mass are not estimated
        # further: keep only the other parameters.
        kept = [i for i, x in enumerate(names)
                if not x.startswith(('law.', 'modes.')) and x not in (*FACTORS, 'bulk_ratio')]
        if not kept:
            return cls()
        free = check_free(names[i] for i in kept)
        try:
            matrix: Array = np.array(flat, dtype=np.float64).ravel()
            numbers = tuple(float(x) for x in values)
        except (TypeError, ValueError):
            raise BadInputError(
                f'{PREFIX}values and {PREFIX}covariance are not all numbers: expected numbers') \
                from None
        if matrix.size == len(names) ** 2:
            matrix = matrix.reshape(len(names), -1)[np.ix_(kept, kept)]
        if len(numbers) == len(names):
            numbers = tuple(numbers[i] for i in kept)
        return cls(free, numbers, matrix)

    def value(self, name: str) -> float | None:
        """Return a value; None if unknown."""
        if name not in self.names or not self.values:
            return None
        return self.values[self.names.index(name)]

    def parameters(self) -> dict[str, list[Any]]:
        """Return the parameters by dotted name, the inverse of `read`."""
        return {
            f'{PREFIX}names': list(self.names), f'{PREFIX}values': list(self.values),
            f'{PREFIX}covariance': self.covariance.ravel().tolist()}
