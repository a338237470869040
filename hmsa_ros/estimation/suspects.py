"""
What may be wrong besides, and which of it samples speak of.

A suspect stays where it was given unless the evidence pays for it, and what is believed is a
mixture over all sets of suspects there may be.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.model.equations import Array

# How improbable a suspect that is not named is before the first sample, as a logarithm, and the
# gain of that of the evidence from which on others are sought in place of those sought.
_PRUDENCE, _CLEARLY = 1.0, 1.0
#: A suspect that is never sought, and what shows much as it does.
GAIN, _LIKE_GAIN = 'stretch_gain', ('remanence', 'chain_limit')
# What shows at rest without field.
_AT_REST = ('stretch_bias', 'constant_force')
# How probable those sought are, or those that show alike, that plans take for certain.
_MOST_LIKELY = 0.5
# How much less probable than the most probable ones suspects are that do not count.
_UNLIKELY = 1e-4


@dataclass(frozen=True, eq=False)
class Suspects:
    """Those there are."""

    names: tuple[str, ...]  # of all coordinates, but for stretch and rate
    places: tuple[int, ...]  # of all suspects
    named: int  # how many of the first coordinates are named
    known: Array  # where coordinates are unless sought, shape (p,)
    priors: Array  # information that there was of these before the first sample, shape (p,)

    def sought(self, count: int, suspected: Iterable[int]) -> NDArray[np.bool_]:
        """Return which of so many coordinates are sought, shape (q,)."""
        found = np.ones(count, dtype=np.bool_)
        found[list(self.places)] = False
        found[list(suspected)] = True
        return found

    def at_ease(self, z: Array, suspected: tuple[int, ...]) -> Array:
        """Return coordinates with what is not sought where it is known to be."""
        there = z.copy()
        there[:len(self.names)] = self.known
        return np.where(self.sought(len(z), suspected), z, there)

    @cached_property
    def sets(self) -> list[tuple[int, ...]]:
        """All sets of suspects; ratio and time of a branch are sought together."""
        groups: dict[str, list[int]] = {}
        for i in self.places:
            groups.setdefault(self.names[i].partition('_')[0], []).append(i)
        return [tuple(itertools.chain(*x)) for count in range(len(groups) + 1)
                for x in itertools.combinations(groups.values(), count)]

    @cached_property
    def seeking(self) -> NDArray[np.bool_]:
        """Which coordinates are sought with each set, shape (n, p)."""
        return np.array([self.sought(len(self.names), x) for x in self.sets])

    @cached_property
    def gain(self) -> int:
        """Place of the gain of the sensor if that is suspected; -1 else."""
        return next((i for i in self.places if self.names[i] == GAIN and i >= self.named), -1)

    @cached_property
    def with_gain(self) -> NDArray[np.bool_]:
        """Which sets have the gain of the sensor, shape (n,)."""
        return np.array([self.gain in x for x in self.sets])

    @cached_property
    def shown_alike(self) -> NDArray[np.int64]:
        """Places of each set, with a gain besides the remanence and in its place, shape (3, n)."""
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
        """Number of each set, one for all that differ by what shows as a gain, shape (n,)."""
        numbers: dict[tuple[int, ...], int] = {}
        return np.array([numbers.setdefault(tuple(
            i for i in x if self.names[i] not in (GAIN, *_LIKE_GAIN)), len(numbers))
            for x in self.sets])

    def of(self, names: Iterable[str], count: int) -> NDArray[np.bool_]:
        """Return which of so many coordinates have one of some names, shape (q,)."""
        found = np.zeros(count, dtype=np.bool_)
        found[[i for i, x in enumerate(self.names) if x in names]] = True
        return found

    @cached_property
    def prudence(self) -> Array:
        """How improbable each suspect is, 0 of the rest, shape (p,); named: as likely as not."""
        found = np.zeros(len(self.names))
        found[list(self.places)] = [_PRUDENCE if x >= self.named else 0.0 for x in self.places]
        return found

    @cached_property
    def ease(self) -> Array:
        """What seeking each suspect adds to the evidence, but for its variance, shape (p,)."""
        found, places = np.zeros(len(self.names)), list(self.places)
        found[places] = 0.5 * np.log(self.priors[places]) - self.prudence[places]
        return found


class Others(NamedTuple):
    """What other sets of suspects than those sought make of what is believed."""

    sure: float  # how probable those sought are
    off: Array  # how far coordinates are expected from those with these, shape (q,)
    square: Array  # what the others add to the expected square of that, shape (q, q)
    # As `off` of what plans use, with what shows as much as a gain of the sensor in its place.
    instead: Array


class Explained(NamedTuple):
    """What samples say if some suspects are sought, of n sets of them."""

    evidence: Array  # logarithm of how probable samples are, but for a constant, shape (n,)
    step: Array  # to the most probable coordinates, shape (n, q)
    loose: NDArray[np.bool_]  # which of them vary, shape (n, q)


@dataclass(frozen=True, eq=False)
class Look:
    """A look at the cost about some coordinates, which is a quadratic there."""

    suspects: Suspects
    z: Array  # the coordinates, shape (q,)
    matrix: Array  # second derivatives
    gradient: Array  # downwards
    low: Array  # least and largest steps
    high: Array

    def choose(self, before: tuple[int, ...]) -> tuple[tuple[int, ...], Others]:
        """Return the suspects to be sought in place of those before, and what of others counts."""
        sets, with_gain = self.suspects.sets, self.suspects.with_gain
        found = self._all()
        # What looks like another remanence may be a gain, or one in part.
        evidence = np.where(with_gain, -math.inf, np.max(
            found.evidence[self.suspects.shown_alike], axis=0))
        here, best = sets.index(before), int(np.argmax(evidence))
        if evidence[best] <= evidence[here] + _CLEARLY:
            best = here
        weight = np.exp(found.evidence - np.max(found.evidence))
        counts = np.flatnonzero((weight > _UNLIKELY) | (np.arange(len(sets)) == best))
        weight = weight[counts] / float(np.sum(weight[counts]))
        apart = found.step[counts] - found.step[best]
        square = np.einsum(
            'k,kij->ij', weight * (counts != best), inverse(self.matrix, found.loose[counts]))
        # Those that count in plans.
        likely = weight
        for some in (counts == best, self.suspects.kinds[counts] == self.suspects.kinds[best]):
            if (share := float(weight @ some)) > _MOST_LIKELY:
                likely = weight * some / share
                break
        return sets[best], Others(
            float(weight @ (counts == best)), weight @ apart,
            square + (weight[:, None] * apart).T @ apart,
            likely @ (self._without_gain(found, counts) - found.step[best]))

    def _without_gain(self, found: Explained, places: NDArray[np.int64]) -> Array:
        """Return the steps of sets of suspects, with other parameters in place of a gain."""
        step, instead = found.step[places], self.suspects.with_gain[places]
        if not instead.any():
            return step
        count = len(self.z)
        # A gain does not show at rest without field: what does stays. The remanence alone, since
        # what J_lim makes up for at one stretch it spoils at others.
        loose = found.loose[places] & ~self.suspects.of((*_AT_REST, GAIN), count)
        loose |= self.suspects.of(('remanence',), count)
        there = np.where(loose, 0.0, step)
        there[:, self.suspects.gain] = 0.0
        return np.where(instead[:, None], _solution(
            self.matrix, self.gradient, there, loose), step)

    def _all(self) -> Explained:
        """
        Return what samples say if sets of suspects are sought.

        The cost and its derivatives are those at z (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
        """
        sought = self.suspects.seeking
        sought = np.pad(
            sought, ((0, 0), (0, len(self.z) - sought.shape[1])), constant_values=True)
        rest = self.suspects.at_ease(self.z, ()) - self.z
        found = self._explained(
            np.where(sought, 0.0, rest), sought, self.suspects.seeking @ self.suspects.ease)
        evidence = found.evidence.copy()
        beyond = np.any(
            (found.step < self.low - 1e-12) | (found.step > self.high + 1e-12), axis=1)
        found.evidence[beyond] = -math.inf
        most = float(np.max(found.evidence))
        # Within bounds samples hardly say more.
        places = np.flatnonzero(beyond & (evidence > most + math.log(_UNLIKELY)))
        bounded = self._bounded(sought[places], rest)
        for i in np.argsort(-evidence[places]).tolist():
            if evidence[places[i]] <= most + math.log(_UNLIKELY):
                break
            for those, one in zip(found, bounded, strict=True):
                those[places[i]] = one[i]
            most = max(most, float(bounded.evidence[i]))
        return found

    def _bounded(self, sought: NDArray[np.bool_], rest: Array) -> Explained:
        """Return as `_all` where the most probable coordinates are within bounds."""
        step, loose = optimum(
            self.matrix, self.gradient, np.broadcast_to(rest, sought.shape), sought, self.low,
            self.high)
        count = len(self.suspects.names)
        return self._explained(np.where(loose, 0.0, step), loose, np.sum(np.where(
            loose[:, :count], self.suspects.ease, np.where(
                sought[:, :count], -self.suspects.prudence, 0.0)), axis=1))

    def _explained(self, there: Array, loose: NDArray[np.bool_], eases: Array) -> Explained:
        """Return what samples say where what does not vary is there."""
        step = _solution(self.matrix, self.gradient, there, loose)
        return Explained(step @ self.gradient - 0.5 * np.einsum(
            'ki,ki->k', step @ self.matrix, step) - 0.5 * np.linalg.slogdet(
                _part(self.matrix, loose))[1] + eases, step, loose)


def _part(matrix: Array, loose: NDArray[np.bool_]) -> Array:
    """Return what varies of a matrix, the identity elsewhere; shape (..., q, q)."""
    return np.where(loose[..., :, None] & loose[..., None, :], matrix, np.eye(len(matrix)))


def _solution(matrix: Array, gradient: Array, there: Array, loose: NDArray[np.bool_]) -> Array:
    """Return the steps to the optimum of a quadratic where what does not vary is there."""
    pull = np.where(loose, gradient - there @ matrix, there)
    found: Array = np.linalg.solve(_part(matrix, loose), pull[..., None])[..., 0]
    return found


def inverse(matrix: Array, sought: NDArray[np.bool_]) -> Array:
    """Return the inverse of what is sought, 0 elsewhere; of shape (..., q) all at once."""
    inner = np.linalg.inv(_part(matrix, sought))
    found: Array = np.where(
        sought[..., :, None] & sought[..., None, :], 0.5 * (inner + inner.swapaxes(-1, -2)), 0.0)
    return found


def optimum(
        matrix: Array, gradient: Array, step: Array, sought: NDArray[np.bool_], low: Array,
        high: Array) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the step to the optimum of a quadratic within bounds, and what varies there.

    What is not sought takes the step given. What would go too far goes as far as it may. Steps
    may be several, of shape (..., q).
    """
    loose = sought.copy()
    while True:
        step = _solution(matrix, gradient, np.where(loose, 0.0, step), loose)
        bounded = np.minimum(np.maximum(step, low), high)
        beyond = loose & (np.abs(bounded - step) > 1e-12)
        if not beyond.any():
            return step, loose
        step = np.where(beyond, bounded, step)
        loose &= ~beyond
