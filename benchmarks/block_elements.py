"""
A block as a continuum, by explicit finite elements, to judge what the package's model omits.

An eighth of a free block by symmetry, or a quarter of one that is glued with a face: bricks of
eight nodes whose dilatation is averaged (Q1P0), a lumped mass and central differences. The
material is that of Gent with a bulk modulus and a viscous deviatoric stress. A uniform
field along the magnetisation is a dead traction on the faces across it (R. Zhao et al., J. Mech.
Phys. Solids 124, 244, 2019). Lengths are in units of L, with G = rho = 1. It shares no equation
with the package.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.model.equations import Array

#: Bulk modulus that stands for constant volume.
BULK = 100.0
# Viscosity of the volume, which damps pressure waves, and the fraction of the largest stable step.
_BULK_VISCOSITY, _STABLE = 0.05, 0.5
# Half the difference of positions for a stiffness, loads on the way to one, Newton's steps to each
# and the forces that remain.
_NEAR, _LOADS, _NEWTON, _BALANCED = 1e-6, 2, 20, 1e-10
# Modes to compute, and those of frequencies this close that act as one.
_MODES, _TOGETHER = 24, 1e-4
# Order of the elimination in a symmetric matrix.
_ORDER = 'MMD_AT_PLUS_A'
_GAUSS = 1.0 / np.sqrt(3.0)


@dataclass
class Block:
    """Positions and velocities of the nodes of a block that starts at rest without a field."""

    shape: float  #: H/L; of a glued block, its whole height over L
    j_lim: float
    viscosity: float  #: of the deviatoric stress, in units of L sqrt(G rho)
    cells: tuple[int, int, int]  #: elements along x, y and z, the direction of the field
    glued: bool = False  #: whether the face opposite to that of the load is fixed
    bulk: float = BULK  #: bulk modulus
    position: Array = field(init=False)  #: shape (n, 3)
    velocity: Array = field(init=False)

    def __post_init__(self) -> None:
        """Make the mesh."""
        sizes = np.array([1.0, 1.0, self.shape]) / self.cells
        axes = [np.arange(x + 1) * y for x, y in zip(self.cells, sizes, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1)
        self._reference = grid.reshape(-1, 3)
        self.position = self._reference.copy()
        self.velocity = np.zeros_like(self.position)
        number = np.arange(len(self.position)).reshape(grid.shape[:3])
        corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        self._nodes = np.stack([
            number[i:i + self.cells[0], j:j + self.cells[1], k:k + self.cells[2]].ravel()
            for i, j, k in corners], axis=1)
        signs = 2.0 * np.array(corners) - 1.0
        # Slopes of the shape functions at the points of the quadrature, shape (8, points, 3).
        parts = 1.0 + _GAUSS * signs[:, None, :] * signs
        slopes = np.stack([
            signs[:, None, k] * np.prod(np.delete(parts, k, axis=2), axis=2)
            for k in range(3)], axis=-1) / 4.0 / sizes
        self._slopes = slopes.reshape(8, -1)
        volume = float(np.prod(sizes))
        self._weight = volume / 8.0
        self._mass = np.bincount(self._nodes.ravel(), minlength=len(grid.reshape(-1, 3))) * (
            volume / 8.0)
        # Nodes in a plane of symmetry stay in it.
        self._free = self.position > 1e-12
        if self.glued:
            self._free &= self._free[:, 2:]
        self._top = number[:, :, -1].ravel()
        edges = [np.where((np.arange(n + 1) % n) == 0, 0.5, 1.0) / n for n in self.cells[:2]]
        self._areas = np.outer(*edges).ravel()
        self._step = _STABLE * float(np.min(sizes)) / np.sqrt(self.bulk + 4.0 / 3.0)

    @property
    def stretch(self) -> float:
        """Mean stretch along the field."""
        return float(self._areas @ self.position[self._top, 2]) / self.shape

    @property
    def side(self) -> float:
        """Largest transverse stretch of the face of the load."""
        return float(np.max(self.position[self._top, 0]))

    def follow(self, pieces: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
        """Follow pieces of duration and load; return times and mean stretches after each step."""
        times, stretches, time = [], [], 0.0
        for duration, load in pieces:
            steps = max(int(np.ceil(duration / self._step)), 1)
            step = duration / steps
            for _ in range(steps):
                force = self._forces()
                force[self._top, 2] += load * self._areas
                self.velocity += step * force / self._mass[:, None]
                self.velocity *= self._free
                self.position += step * self.velocity
                time += step
                times.append(time)
                stretches.append(self.stretch)
        return np.array(times), np.array(stretches)

    def settle(self, load: float) -> None:
        """Bring the block to rest under a load, by Newton's method."""
        from scipy.sparse.linalg import splu

        moves = np.flatnonzero(self._free)
        self.velocity[:] = 0.0
        for part in np.arange(1, _LOADS + 1) / _LOADS:
            for _ in range(_NEWTON):
                force = self._forces()
                force[self._top, 2] += part * load * self._areas
                off = force.ravel()[moves]
                if np.max(np.abs(off)) < _BALANCED:
                    break
                self.position.ravel()[moves] += splu(
                    self._stiffness(moves), _ORDER).solve(off)

    def deform(self, along: float, across: float) -> None:
        """Deform the block uniformly, at rest."""
        self.position = self._reference * np.array([across, across, along])
        self.velocity[:] = 0.0

    def modes(self) -> tuple[Array, Array]:
        """Return frequencies of small motion about here, and shares of the mean static stretch."""
        from scipy.sparse.linalg import eigsh, LinearOperator, splu

        moves = np.flatnonzero(self._free)
        stiffness = self._stiffness(moves)
        scale = np.repeat(self._mass, 3)[moves] ** -0.5
        load = np.zeros_like(self.position)
        load[self._top, 2] = self._areas
        pull = load.ravel()[moves]
        scaled = stiffness.multiply(scale[:, None]).multiply(scale).tocsc()
        solve = splu(scaled, _ORDER).solve
        squared, vectors = eigsh(
            scaled, _MODES, sigma=0.0, v0=np.ones(len(scale)),
            OPinv=LinearOperator(scaled.shape, solve))
        pull = scale * pull
        shares = (vectors.T @ pull) ** 2 / squared / float(pull @ solve(pull))
        frequencies = np.sqrt(squared)
        order = np.argsort(frequencies)
        frequencies, shares = frequencies[order], shares[order]
        groups = np.cumsum(np.append(0, np.diff(frequencies) > _TOGETHER * frequencies[1:]))
        first = np.searchsorted(groups, np.arange(groups[-1] + 1))
        return frequencies[first], np.asarray(np.bincount(groups, shares), np.float64)

    def _stiffness(self, moves: NDArray[np.intp]) -> Any:
        """Return the stiffness of the free displacements, as a sparse matrix."""
        from scipy.sparse import coo_array

        around, still = self.position[self._nodes], np.zeros((len(self._nodes), 8, 3))
        columns = []
        for i in range(24):
            ahead, behind = around.copy(), around.copy()
            ahead.reshape(-1, 24)[:, i] += _NEAR
            behind.reshape(-1, 24)[:, i] -= _NEAR
            columns.append((self._of_elements(behind, still) - self._of_elements(ahead, still))
                           .reshape(-1, 24) / (2.0 * _NEAR))
        each = np.stack(columns, axis=2)
        each = 0.5 * (each + each.transpose(0, 2, 1))
        places = (3 * self._nodes[:, :, None] + np.arange(3)).reshape(-1, 24)
        rows = np.broadcast_to(places[:, :, None], each.shape).ravel()
        whole = coo_array(
            (each.ravel(), (rows, np.broadcast_to(places[:, None, :], each.shape).ravel())),
            shape=(self.position.size,) * 2).tocsc()
        return whole[moves][:, moves].tocsc()

    def _forces(self) -> Array:
        """Return minus the internal forces of the nodes."""
        each = self._of_elements(self.position[self._nodes], self.velocity[self._nodes])
        force = np.zeros_like(self.position)
        for axis in range(3):
            force[:, axis] = np.bincount(
                self._nodes.ravel(), each[..., axis].ravel(), minlength=len(force))
        return force

    def _of_elements(self, position: Array, velocity: Array) -> Array:
        """Return minus the internal forces of elements with nodes at positions (n, 8, 3)."""
        count = len(position)

        def gradients(of: Array) -> Array:
            # Shape (elements, points, 3, 3).
            found: Array = np.matmul(of.transpose(0, 2, 1), self._slopes)
            return found.reshape(count, 3, 8, 3).transpose(0, 2, 1, 3)

        deformation, rate = gradients(position), gradients(velocity)
        volume, inverse = np.linalg.det(deformation), np.linalg.inv(deformation)
        # Velocity gradient.
        flow = rate @ inverse
        expansion = np.trace(flow, axis1=2, axis2=3)
        pressure = self.bulk * (volume.mean(axis=1) - 1.0) + _BULK_VISCOSITY * (
            volume * expansion).mean(axis=1)
        scale = volume ** (-2.0 / 3.0)
        invariant = np.sum(deformation ** 2, axis=(2, 3))
        slope = scale / (1.0 - (scale * invariant - 3.0) / self.j_lim)
        identity = np.eye(3)
        # Kirchhoff stress, then the first Piola stress.
        stress = slope[..., None, None] * (
            deformation @ deformation.swapaxes(2, 3) - invariant[..., None, None] / 3.0 * identity)
        stress += self.viscosity * volume[..., None, None] * (
            flow + flow.swapaxes(2, 3) - 2.0 / 3.0 * expansion[..., None, None] * identity)
        stress += (pressure[:, None] * volume)[..., None, None] * identity
        piola = stress @ inverse.swapaxes(2, 3)
        each: Array = np.matmul(
            piola.transpose(0, 2, 1, 3).reshape(count, 3, -1), self._slopes.T) * -self._weight
        return each.transpose(0, 2, 1)
