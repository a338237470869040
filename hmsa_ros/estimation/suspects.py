"""
What may be wrong besides, and which of it samples speak of.

A suspect stays where it was given unless the evidence pays for it, and what is believed is a
mixture over all sets of suspects there may be.
"""

from collections.abc import Iterable, Sequence
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
# What a gain that explains samples in its place counts against a force at most, as a logarithm.
_BESIDES = 2.0
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

    def forced(self, follows: Array) -> Array:
        """
        Return what a force that is not sought adds to variances, by how coordinates follow it.

        It may be anything, whatever samples say (S. F. Schmidt, Advances in Control Systems 3
        (1966) 293).
        """
        force = [i for i in self.places if self.names[i] == 'constant_force']
        return np.square(follows[:, force]) @ (1.0 / self.priors[force])

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
    def eases(self) -> Array:
        """What seeking each set adds to the evidence, shape (n,)."""
        return np.array([sum(map(self.ease, x)) for x in self.sets])

    def ease(self, place: int) -> float:
        """Return what seeking a suspect adds to the evidence, but for its variance."""
        return 0.5 * math.log(self.priors[place]) - self.prudence(place)

    def prudence(self, place: int) -> float:
        """Return how improbable a suspect is; one that is named is as likely as not."""
        return _PRUDENCE if place >= self.named else 0.0


class Others(NamedTuple):
    """What other sets of suspects than those sought make of what is believed."""

    sure: float  # how probable those sought are
    off: Array  # how far coordinates are expected from those with these, shape (q,)
    square: Array  # what the others add to the expected square of that, shape (q, q)


class Explained(NamedTuple):
    """What samples say if some suspects are sought."""

    evidence: float  # logarithm of how probable samples are, but for a constant
    step: Array  # to the most probable coordinates
    covariance: Array  # of those that are sought, 0 of the others, shape (q, q)


class Gain(NamedTuple):
    """How the cost goes with usual errors of the gain of the sensor."""

    gradient: float  # downwards
    cross: Array  # second derivatives by such an error and the coordinates, shape (q,)
    curvature: float  # second derivative, at least that of what is usual, 1

    def explains(self, found: Sequence[Explained]) -> Array:
        """Return what an error of the gain besides adds to each evidence, if anything."""
        rest = self.gradient - np.array([x.step for x in found]) @ self.cross
        curvature = np.maximum(self.curvature - (
            np.array([x.covariance for x in found]) @ self.cross) @ self.cross, 1.0)
        more: Array = np.maximum(0.5 * rest ** 2 / curvature - 0.5 * np.log(curvature), 0.0)
        return more


@dataclass(frozen=True, eq=False)
class Look:
    """A look at the cost about some coordinates, which is a quadratic there."""

    suspects: Suspects
    z: Array  # the coordinates, shape (q,)
    matrix: Array  # second derivatives
    gradient: Array  # downwards
    low: Array  # least and largest steps
    high: Array
    gain: Gain

    def choose(self, before: tuple[int, ...]) -> tuple[tuple[int, ...], Others]:
        """Return the suspects to be sought in place of those before, and what of others counts."""
        sets = self.suspects.sets
        found = self._with_gain(self._all())
        here = sets.index(before)
        best = max(range(len(sets)), key=lambda x: found[x].evidence)
        if found[best].evidence <= found[here].evidence + _CLEARLY:
            best = here
        total, off, square = 0.0, np.zeros_like(self.z), np.zeros_like(self.matrix)
        for i, x in enumerate(found):
            weight = math.exp(min(x.evidence - found[best].evidence, _CLEARLY))
            if weight > _UNLIKELY:
                total += weight
                apart = x.step - found[best].step
                off += weight * apart
                square += (i != best) * weight * (x.covariance + np.outer(apart, apart))
        return sets[best], Others(1.0 / total, off / total, square / total)

    def _with_gain(self, found: list[Explained]) -> list[Explained]:
        """
        Return the same where a gain may be wrong besides.

        What looks like another remanence may be a gain in part, and a force is less probable where
        a gain in its place explains samples too.
        """
        remanence, force = ({i for i in self.suspects.places if self.suspects.names[i] == x}
                            for x in ('remanence', 'constant_force'))
        explains: dict[tuple[int, ...], float] = dict(
            zip(self.suspects.sets, self.gain.explains(found).tolist(), strict=True))

        def more(suspected: tuple[int, ...]) -> float:
            if remanence & {*suspected}:
                return explains[suspected]
            if force & {*suspected}:
                return -min(explains[tuple(x for x in suspected if x not in force)], _BESIDES)
            return 0.0

        return [x._replace(evidence=x.evidence + more(y))
                for x, y in zip(found, self.suspects.sets, strict=True)]

    def _all(self) -> list[Explained]:
        """
        Return what samples say if sets of suspects are sought.

        The cost and its derivatives are those at z (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
        """
        sets, sought = self.suspects.sets, self.suspects.seeking
        sought = np.pad(
            sought, ((0, 0), (0, len(self.z) - sought.shape[1])), constant_values=True)
        rest = self.suspects.at_ease(self.z, ()) - self.z
        both = sought[:, :, None] & sought[:, None, :]
        matrix = np.where(both, self.matrix, np.eye(len(self.z)))
        there = np.where(sought, 0.0, rest)
        covariance = np.linalg.inv(matrix)
        pull = np.where(sought, self.gradient - there @ self.matrix, 0.0)
        step = there + np.einsum('kij,kj->ki', covariance, pull)
        evidence = step @ self.gradient - 0.5 * np.einsum(
            'ki,ki->k', step @ self.matrix, step) - 0.5 * np.linalg.slogdet(
                matrix)[1] + self.suspects.eases
        covariance = np.where(both, covariance, 0.0)
        beyond = np.any((step < self.low - 1e-12) | (step > self.high + 1e-12), axis=1)
        found = [Explained(-math.inf if beyond[i] else float(evidence[i]), step[i], covariance[i])
                 for i in range(len(sets))]
        most = max(x.evidence for x in found)
        # Within bounds samples hardly say more.
        for i in np.argsort(-evidence).tolist():
            if evidence[i] <= most + math.log(_UNLIKELY):
                break
            if beyond[i]:
                found[i] = self._bounded(sets[i], sought[i], rest)
                most = max(most, found[i].evidence)
        return found

    def _bounded(
            self, suspected: tuple[int, ...], sought: NDArray[np.bool_], rest: Array) -> Explained:
        """Return as `_all` where the most probable coordinates are within bounds."""
        matrix, gradient = self.matrix, self.gradient
        step, loose = optimum(matrix, gradient, rest, sought, self.low, self.high)
        covariance = inverse(matrix, loose)
        return Explained(
            float(gradient @ step - 0.5 * step @ matrix @ step) + 0.5 * float(
                np.linalg.slogdet(covariance[np.ix_(loose, loose)])[1]) + sum(
                self.suspects.ease(i) if loose[i] else -self.suspects.prudence(i)
                for i in suspected),
            step, covariance)


def inverse(matrix: Array, sought: NDArray[np.bool_]) -> Array:
    """Return the inverse of what is sought, 0 elsewhere."""
    found, places = np.zeros_like(matrix), np.flatnonzero(sought)
    inner = np.linalg.inv(matrix[places[:, None], places])
    found[places[:, None], places] = 0.5 * (inner + inner.T)
    return found


def optimum(
        matrix: Array, gradient: Array, step: Array, sought: NDArray[np.bool_], low: Array,
        high: Array) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the step to the optimum of a quadratic within bounds, and what varies there.

    What is not sought takes the step given. What would go too far goes as far as it may.
    """
    step, loose = step.copy(), sought.copy()
    while True:
        places = np.flatnonzero(loose)
        step[places] = 0.0
        step[places] = np.linalg.solve(
            matrix[places[:, None], places], gradient[places] - matrix[places] @ step)
        bounded = np.minimum(np.maximum(step, low), high)
        beyond = loose & (np.abs(bounded - step) > 1e-12)
        if not beyond.any():
            return step, loose
        step[beyond] = bounded[beyond]
        loose &= ~beyond
