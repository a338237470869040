"""
Hypotheses: further parameters that may be in error, and the evidence for them.

A suspect keeps its given value unless the evidence supports a change. The estimate is a mixture
over all possible sets of suspects.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa.model.equations import Array
from hmsa.motion import subset_inverses, subsets

# Prior improbability of a suspect that is not named, as a logarithm, and the gain of log evidence
# above which the set of estimated suspects changes.
_PRUDENCE, _CLEARLY = 1.0, 1.0
#: A suspect that is never estimated, and parameters with a similar effect.
GAIN, _LIKE_GAIN = 'stretch_gain', ('remanence', 'chain_limit')
# Quantities with an effect at rest without field.
_AT_REST = ('stretch_bias', 'constant_force')
# Probability above which plans take a set, or those with similar effects, as certain.
_MOST_LIKELY = 0.5
# Probability relative to the most probable set below which sets are ignored.
_UNLIKELY = 1e-4


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The suspects of an estimator."""

    names: tuple[str, ...]  # of all coordinates, except stretch and rate
    places: tuple[int, ...]  # indices of all suspects
    named: int  # number of named coordinates, which come first
    known: Array  # coordinates unless estimated, shape (p,)
    priors: Array  # prior information of these, shape (p,)

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process without the sets, which are large and computed only once there."""
        return hypotheses, (
            self.names, self.places, self.named, tuple(self.known.tolist()),
            tuple(self.priors.tolist()))

    def sought(self, count: int, suspected: Iterable[int]) -> NDArray[np.bool_]:
        """Return which coordinates are estimated, shape (q,)."""
        found = np.ones(count, dtype=np.bool_)
        found[list(self.places)] = False
        found[list(suspected)] = True
        return found

    def at_ease(self, z: Array, suspected: tuple[int, ...]) -> Array:
        """Return coordinates with the given values for those that are not estimated."""
        there = z.copy()
        there[:len(self.names)] = self.known
        return np.where(self.sought(len(z), suspected), z, there)

    @cached_property
    def sets(self) -> list[tuple[int, ...]]:
        """All sets of suspects; ratio and time of a branch are estimated together."""
        groups: dict[str, list[int]] = {}
        for i in self.places:
            groups.setdefault(self.names[i].partition('_')[0], []).append(i)
        return [tuple(itertools.chain(*x)) for count in range(len(groups) + 1)
                for x in itertools.combinations(groups.values(), count)]

    @cached_property
    def seeking(self) -> NDArray[np.bool_]:
        """Which coordinates are estimated with each set, shape (n, p)."""
        return np.array([self.sought(len(self.names), x) for x in self.sets])

    @cached_property
    def gain(self) -> int:
        """Index of the gain of the sensor if it is suspected; else -1."""
        return next((i for i in self.places if self.names[i] == GAIN and i >= self.named), -1)

    @cached_property
    def with_gain(self) -> NDArray[np.bool_]:
        """Which sets contain the gain of the sensor, shape (n,)."""
        return np.array([self.gain in x for x in self.sets])

    @cached_property
    def shown_alike(self) -> NDArray[np.int64]:
        """Indices of each set, with a gain added to it and in place of remanence, shape (3, n)."""
        places = {x: i for i, x in enumerate(self.sets)}
        found = []
        for own in self.sets:
            others = tuple(i for i in own if self.names[i] != 'remanence')
            either = self.gain >= 0 and self.gain not in own and others != own
            found.append([places[x] for x in (
                own, (*own, self.gain) if either else own,
                (*others, self.gain) if either else own)])
        return np.array(found).T

    @cached_property
    def kinds(self) -> NDArray[np.int64]:
        """Number per set, equal for sets that differ by gain-like suspects only, shape (n,)."""
        numbers: dict[tuple[int, ...], int] = {}
        return np.array([numbers.setdefault(tuple(
            i for i in x if self.names[i] not in (GAIN, *_LIKE_GAIN)), len(numbers))
            for x in self.sets])

    def of(self, names: Iterable[str], count: int) -> NDArray[np.bool_]:
        """Return which coordinates have one of some names, shape (q,)."""
        found = np.zeros(count, dtype=np.bool_)
        found[[i for i, x in enumerate(self.names) if x in names]] = True
        return found

    @cached_property
    def prudence(self) -> Array:
        """Improbability of each suspect, 0 for named ones and the rest, shape (p,)."""
        found = np.zeros(len(self.names))
        found[list(self.places)] = [_PRUDENCE if x >= self.named else 0.0 for x in self.places]
        return found

    @cached_property
    def ease(self) -> Array:
        """Contribution of each suspect to the evidence, without its variance, shape (p,)."""
        found, places = np.zeros(len(self.names)), list(self.places)
        found[places] = 0.5 * np.log(self.priors[places]) - self.prudence[places]
        return found

    @cached_property
    def eases(self) -> Array:
        """Contribution of the suspects of each set to the evidence, shape (n,)."""
        return self.seeking @ self.ease


@lru_cache(maxsize=64)
def _seeking(suspects: Hypotheses, count: int) -> NDArray[np.bool_]:
    """Return which of ``count`` coordinates are estimated with each set, shape (n, q)."""
    found = suspects.seeking
    found = np.pad(found, ((0, 0), (0, count - found.shape[1])), constant_values=True)
    found.setflags(write=False)
    return found


@lru_cache(maxsize=64)
def hypotheses(
        names: tuple[str, ...], places: tuple[int, ...], named: int, known: tuple[float, ...],
        priors: tuple[float, ...]) -> Hypotheses:
    """Return the suspects with the given fields, always the same object."""
    return Hypotheses(names, places, named, np.array(known), np.array(priors))


class Others(NamedTuple):
    """Contribution of other sets of suspects to the estimate."""

    sure: float  # probability of the estimated set
    off: Array  # expected minus estimated coordinates, shape (q,)
    square: Array  # contribution to the expected square of that, shape (q, q)
    # As `off` for plans, where other parameters represent an apparent gain of the sensor.
    instead: Array


class Explained(NamedTuple):
    """Evidence and optimum for n sets of suspects."""

    evidence: Array  # log probability of the samples, up to a constant, shape (n,)
    step: Array  # to the most probable coordinates, shape (n, q)
    loose: NDArray[np.bool_]  # which of them vary, shape (n, q)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Quadratic approximation of the cost about some coordinates."""

    suspects: Hypotheses
    z: Array  # the coordinates, shape (q,)
    matrix: Array  # second derivatives
    gradient: Array  # negative first derivatives
    low: Array  # minimum and maximum steps
    high: Array

    def choose(self, before: tuple[int, ...]) -> tuple[tuple[int, ...], Others]:
        """Return the suspects to estimate instead of those before, and the effect of others."""
        sets, with_gain = self.suspects.sets, self.suspects.with_gain
        found = self._all()
        # An apparent change of remanence may be a gain, entirely or in part.
        evidence = np.where(with_gain, -math.inf, np.max(
            found.evidence[self.suspects.shown_alike], axis=0))
        here, best = sets.index(before), int(np.argmax(evidence))
        if evidence[best] <= evidence[here] + _CLEARLY:
            best = here
        weight = np.exp(found.evidence - np.max(found.evidence))
        counts = np.flatnonzero((weight > _UNLIKELY) | (np.arange(len(sets)) == best))
        weight = weight[counts] / float(np.sum(weight[counts]))
        apart = found.step[counts] - found.step[best]
        square = (weight[:, None] * apart).T @ apart
        subset_inverses(
            np.ascontiguousarray(self.matrix), found.loose[counts], weight * (counts != best),
            square)
        # Probabilities for plans.
        likely = weight
        for some in (counts == best, self.suspects.kinds[counts] == self.suspects.kinds[best]):
            if (share := float(weight @ some)) > _MOST_LIKELY:
                likely = weight * some / share
                break
        return sets[best], Others(
            float(weight @ (counts == best)), weight @ apart, square,
            likely @ (self._without_gain(found, counts) - found.step[best]))

    def best(self) -> float:
        """Return the log probability of the most probable set of suspects."""
        return float(np.max(self._all().evidence))

    def with_more(self, across: Array, square: Array, gradient: Array) -> 'Evidence':
        """Return it with n further coordinates that vary; second derivatives (q, n) and (n, n)."""
        more = np.full(len(gradient), math.inf)
        return Evidence(
            self.suspects, np.append(self.z, 0.0 * gradient),
            np.block([[self.matrix, across], [across.T, square]]),
            np.append(self.gradient, gradient), np.append(self.low, -more),
            np.append(self.high, more))

    def _without_gain(self, found: Explained, places: NDArray[np.int64]) -> Array:
        """Return the steps for sets of suspects, with other parameters in place of a gain."""
        step, instead = found.step[places], self.suspects.with_gain[places]
        if not instead.any():
            return step
        count = len(self.z)
        # A gain has no effect at rest without field, so quantities with one there stay. Only the
        # remanence varies, since J_lim would compensate at one stretch and err at others.
        loose = found.loose[places] & ~self.suspects.of((*_AT_REST, GAIN), count)
        loose |= self.suspects.of(('remanence',), count)
        there = np.where(loose, 0.0, step)
        there[:, self.suspects.gain] = 0.0
        return np.where(instead[:, None], _solution(
            self.matrix, self.gradient, there, loose)[0], step)

    def _all(self) -> Explained:
        """
        Return evidence and optimum for all sets of suspects.

        The cost and its derivatives are those at z (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
        """
        sought = _seeking(self.suspects, len(self.z)).copy()
        rest = self.suspects.at_ease(self.z, ()) - self.z
        found = self._explained(np.where(sought, 0.0, rest), sought, self.suspects.eases)
        evidence = found.evidence.copy()
        beyond = np.any(
            (found.step < self.low - 1e-12) | (found.step > self.high + 1e-12), axis=1)
        found.evidence[beyond] = -math.inf
        # Bounds hardly increase the evidence.
        places = np.flatnonzero(
            beyond & (evidence > float(np.max(found.evidence)) + math.log(_UNLIKELY)))
        for those, one in zip(found, self._bounded(sought[places], rest), strict=True):
            those[places] = one
        return found

    def _bounded(self, sought: NDArray[np.bool_], rest: Array) -> Explained:
        """Return as `_all`, with the most probable coordinates within bounds."""
        step, loose = optimum(
            self.matrix, self.gradient, np.broadcast_to(rest, sought.shape), sought, self.low,
            self.high)
        count = len(self.suspects.names)
        return self._explained(np.where(loose, 0.0, step), loose, np.sum(np.where(
            loose[:, :count], self.suspects.ease, np.where(
                sought[:, :count], -self.suspects.prudence, 0.0)), axis=1))

    def _explained(self, there: Array, loose: NDArray[np.bool_], eases: Array) -> Explained:
        """Return evidence and optimum with given values for fixed coordinates."""
        step, log_det = _solution(self.matrix, self.gradient, there, loose)
        return Explained(step @ self.gradient - 0.5 * (np.einsum(
            'ki,ki->k', step @ self.matrix, step) + log_det) + eases, step, loose)


def _solution(
        matrix: Array, gradient: Array, there: Array, loose: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """
    Return the steps to the optimum of a quadratic with given steps where fixed.

    Also return the logarithms of the determinants of the varying parts of the matrix.
    """
    step = np.where(loose, gradient - there @ matrix, there)
    log_det = np.empty(math.prod(loose.shape[:-1]))
    subsets(np.ascontiguousarray(matrix), np.ascontiguousarray(loose), step, log_det)
    return step, log_det


def inverse(matrix: Array, sought: NDArray[np.bool_]) -> Array:
    """Return the inverse over the estimated part, 0 elsewhere."""
    both = np.outer(sought, sought)
    inner = np.linalg.inv(np.where(both, matrix, np.eye(len(matrix))))
    return np.where(both, 0.5 * (inner + inner.T), 0.0)


def optimum(
        matrix: Array, gradient: Array, step: Array, sought: NDArray[np.bool_], low: Array,
        high: Array) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the step to the optimum of a quadratic within bounds, and which coordinates vary.

    Fixed coordinates take the given step; those that would exceed a bound stop at it. Steps may be
    batched, of shape (..., q).
    """
    loose = sought.copy()
    while True:
        step, _ = _solution(matrix, gradient, np.where(loose, 0.0, step), loose)
        bounded = np.minimum(np.maximum(step, low), high)
        beyond = loose & (np.abs(bounded - step) > 1e-12)
        if not beyond.any():
            return step, loose
        step = np.where(beyond, bounded, step)
        loose &= ~beyond
