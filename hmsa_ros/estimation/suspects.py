"""
What may be wrong besides, and which of it samples speak of.

A suspect stays where it was given unless the evidence pays for it, and the covariance is a mixture
over the sets of suspects there may be. What is only considered is never sought.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.model.equations import Array

# A suspect is sought from this gain of the logarithm of the evidence on, and others in place of
# those sought from this one on.
_PRUDENCE, _CLEARLY = 2.0, 1.0
# How much less probable than the most probable ones suspects are that do not count.
_UNLIKELY = 1e-4


@dataclass(frozen=True, eq=False)
class Suspects:
    """Those there are: the last of the coordinates, but for stretch and rate."""

    names: tuple[str, ...]  # of all coordinates
    known: Array  # of suspects and what is considered: where they are unless sought, shape (s,)
    priors: Array  # information that there was of these before the first sample, shape (s,)
    considered: int = 0  # how many of these, from the last on, are never sought

    @property
    def _first(self) -> int:
        return len(self.names) - len(self.known)

    @property
    def places(self) -> tuple[int, ...]:
        """Places of all suspects."""
        return tuple(range(self._first, len(self.names) - self.considered))

    def sought(self, count: int, suspected: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return which of so many coordinates are sought, shape (q,)."""
        found = np.ones(count, dtype=np.bool_)
        found[self._first:len(self.names)] = False
        found[list(suspected)] = True
        return found

    def at_ease(self, z: Array, suspected: tuple[int, ...]) -> Array:
        """Return coordinates with what is not sought where it is known to be."""
        there = z.copy()
        there[self._first:len(self.names)] = self.known
        return np.where(self.sought(len(z), suspected), z, there)

    def groups(self, places: Iterable[int]) -> list[list[int]]:
        """Return which suspects are sought together: ratio and time of a branch."""
        groups: dict[str, list[int]] = {}
        for i in places:
            groups.setdefault(self.names[i].partition('_')[0], []).append(i)
        return list(groups.values())

    def ease(self, place: int) -> float:
        """Return what seeking a suspect adds to the evidence, but for its variance."""
        return 0.5 * math.log(self.priors[place - self._first]) - _PRUDENCE

    def considering(self, covariance: Array, matrix: Array, prior: Array) -> Array:
        """
        Return a covariance of what is sought with what is considered.

        That stays as unsure as it is, whatever samples say, and the others are off by what it
        makes of them (S. F. Schmidt, Advances in Control Systems 3 (1966) 293).
        """
        if not self.considered:
            return covariance.copy()
        places = slice(len(self.names) - self.considered, len(self.names))
        change = -covariance @ matrix[:, places]
        change[places] = np.eye(self.considered)
        found: Array = covariance + change @ prior[places, places] @ change.T
        return found


class Explained(NamedTuple):
    """What samples say if some suspects are sought."""

    suspected: tuple[int, ...]  # places of these
    likelihood: float  # logarithm of that of the most probable coordinates, but for a constant
    evidence: float  # of how probable samples are, but for another one
    step: Array  # to the most probable coordinates
    covariance: Array  # of those that are sought, 0 of the others, shape (q, q)


class Beside(NamedTuple):
    """How another set of suspects differs, by a group that is sought in it or is not."""

    suspected: tuple[int, ...]
    evidence: float
    by: Array  # how coordinates follow those of the group, shape (q, k)
    step: Array  # of the group, from the most probable coordinates to those of the other set
    more: Array  # variance of the group beyond that there is, shape (k, k)


@dataclass(frozen=True, eq=False)
class Look:
    """A look at the cost about some coordinates, which is a quadratic there."""

    suspects: Suspects
    z: Array  # the coordinates, shape (q,)
    matrix: Array  # second derivatives
    gradient: Array  # downwards
    low: Array  # least and largest steps
    high: Array
    prior: Array  # covariance before these samples

    def choose(self, before: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[float, Array]]:
        """
        Return the suspects to be sought, and what not being sure of these makes of the covariance.

        The fewer the better, unless samples are much less probable without. Tried are the set in
        use, the best one beside it, and what is left of all that have something to say.
        """
        here = best = self._explained(before)
        around = self._beside(here)
        others = {max(around, key=lambda x: x.evidence).suspected} if around else set()
        whole = self._explained(self.suspects.places)
        if whole.likelihood > here.likelihood + _PRUDENCE:
            others.add(self._pruned(whole))
        for suspected in others - {before}:
            found = self._explained(suspected)
            if found.evidence > max(
                    best.evidence, here.evidence + _CLEARLY * (best is here)):
                best = found
        if best is not here:
            around = self._beside(best)
        return best.suspected, self._spread(best, around)

    def _pruned(self, found: Explained) -> tuple[int, ...]:
        """Return what is left of suspects without those, one by one, that samples do not need."""
        while found.suspected:
            other = max((
                self._without(found, x) for x in self.suspects.groups(found.suspected)),
                key=lambda x: x.evidence)
            if other.evidence <= found.evidence:
                break
            found = Explained(
                other.suspected, math.nan, other.evidence, found.step + other.by @ other.step,
                found.covariance + other.by @ other.more @ other.by.T)
        return found.suspected

    def _explained(self, suspected: tuple[int, ...]) -> Explained:
        """
        Return what samples say if these suspects are sought.

        The cost and its derivatives are those at z (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
        """
        z, matrix, gradient = self.z, self.matrix, self.gradient
        step, sought = optimum(
            matrix, gradient, self.suspects.at_ease(z, ()) - z,
            self.suspects.sought(len(z), suspected), self.low, self.high)
        covariance = inverse(matrix, sought)
        likelihood = float(gradient @ step - 0.5 * step @ matrix @ step)
        evidence = likelihood + 0.5 * float(
            np.linalg.slogdet(covariance[np.ix_(sought, sought)])[1]) + sum(
            self.suspects.ease(i) if sought[i] else -_PRUDENCE for i in suspected)
        return Explained(suspected, likelihood, evidence, step, covariance)

    def _beside(self, here: Explained) -> list[Beside]:
        """Return sets of suspects with one more and one fewer; a branch is ratio and time."""
        matrix = self.matrix
        pull, low, high = (
            self.gradient - matrix @ here.step, self.low - here.step, self.high - here.step)
        follows = -here.covariance @ matrix
        inner = np.maximum(
            np.diag(matrix) + np.einsum('ij,ji->i', matrix, follows),
            # That samples know less than before is by rounding.
            1.0 / np.diag(self.prior))
        found = []
        for group in self.suspects.groups(self.suspects.places):
            if group[0] in here.suspected:
                found.append(self._without(here, group))
                continue
            by = follows[:, group]
            by[group, range(len(group))] += 1.0
            if len(group) == 1:
                i = group[0]
                best = float(pull[i] / inner[i])
                step = np.array([min(max(best, float(low[i])), float(high[i]))])
                loose = step == best
                variance = np.where(loose, 1.0 / inner[i], 0.0)[:, None]
                gain = float(pull[i] * step[0] - 0.5 * inner[i] * step[0] ** 2)
                gain -= 0.5 * math.log(inner[i]) * bool(loose[0])
            else:
                block = matrix[group] @ by
                step, loose = optimum(
                    block, pull[group], np.zeros(len(group)), np.ones(len(group), np.bool_),
                    low[group], high[group])
                variance = np.zeros_like(block)
                variance[np.ix_(loose, loose)] = np.linalg.inv(block[np.ix_(loose, loose)])
                gain = float(pull[group] @ step - 0.5 * step @ block @ step) - 0.5 * float(
                    np.linalg.slogdet(block[np.ix_(loose, loose)])[1])
            gain += sum(self.suspects.ease(i) if x else -_PRUDENCE
                        for i, x in zip(group, loose.tolist(), strict=True))
            found.append(Beside(
                tuple(sorted({*here.suspected, *group})), here.evidence + gain, by, step,
                variance))
        return found

    def _without(self, here: Explained, group: list[int]) -> Beside:
        """Return the set that is left where a group of suspects is not sought any more."""
        # Those that are sought, but lie at a bound, do not vary.
        own = [i for i in group if here.covariance[i, i] > 0.0]
        variance = here.covariance[np.ix_(own, own)]
        inner = np.linalg.inv(variance)
        step = (self.suspects.at_ease(self.z, ()) - self.z - here.step)[own]
        loss = 0.5 * float(step @ inner @ step + np.linalg.slogdet(variance)[1]) + sum(
            self.suspects.ease(i) if i in own else -_PRUDENCE for i in group)
        return Beside(
            tuple(x for x in here.suspected if x not in group), here.evidence - loss,
            here.covariance[:, own] @ inner, step, -variance)

    def _spread(
            self, chosen: Explained, beside: Sequence[Beside]) -> tuple[float, Array]:
        """Return how probable the suspects chosen are, and what others add to the covariance."""
        covariance, total = np.zeros_like(self.matrix), 1.0
        for other in beside:
            weight = math.exp(min(other.evidence - chosen.evidence, 0.0))
            if weight > _UNLIKELY:
                apart = other.by @ other.step
                covariance += weight * (self.suspects.considering(
                    chosen.covariance + other.by @ other.more @ other.by.T, self.matrix,
                    self.prior) + np.outer(apart, apart))
                total += weight
        return 1.0 / total, covariance / total


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
