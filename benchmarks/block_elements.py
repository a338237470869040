"""
A block as a continuum, by explicit finite elements, to judge what the package's model omits.

An eighth of a free block by symmetry, or a quarter of one that is glued with a face: bricks of
eight nodes whose dilatation is averaged (Q1P0), a lumped mass and central differences. The
material is that of Gent with a bulk modulus far above G and a viscous deviatoric stress. A uniform
field along the magnetisation is a dead traction on the faces across it (R. Zhao et al., J. Mech.
Phys. Solids 124, 244, 2019). Lengths are in units of L, with G = rho = 1. It shares no equation
with the package.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hmsa.model.equations import Array

# Bulk modulus, and its viscosity, which damps pressure waves; and the fraction of the largest
# stable step.
_BULK, _BULK_VISCOSITY, _STABLE = 100.0, 0.05, 0.5
_GAUSS = 1.0 / np.sqrt(3.0)


@dataclass
class Block:
    """Positions and velocities of the nodes of a block that starts at rest without a field."""

    shape: float  #: H/L; of a glued block, its whole height over L
    j_lim: float
    viscosity: float  #: of the deviatoric stress, in units of L sqrt(G rho)
    cells: tuple[int, int, int]  #: elements along x, y and z, the direction of the field
    glued: bool = False  #: whether the face opposite to that of the load is fixed
    position: Array = field(init=False)  #: shape (n, 3)
    velocity: Array = field(init=False)

    def __post_init__(self) -> None:
        """Make the mesh."""
        sizes = np.array([1.0, 1.0, self.shape]) / self.cells
        axes = [np.arange(x + 1) * y for x, y in zip(self.cells, sizes, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1)
        self.position = grid.reshape(-1, 3).copy()
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
        self._step = _STABLE * float(np.min(sizes)) / np.sqrt(_BULK + 4.0 / 3.0)

    @property
    def stretch(self) -> float:
        """Mean stretch along the field."""
        return float(self._areas @ self.position[self._top, 2]) / self.shape

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

    def _forces(self) -> Array:
        """Return minus the internal forces of the nodes."""
        count = len(self._nodes)

        def gradients(of: Array) -> Array:
            # Shape (elements, points, 3, 3).
            found: Array = np.matmul(of[self._nodes].transpose(0, 2, 1), self._slopes)
            return found.reshape(count, 3, 8, 3).transpose(0, 2, 1, 3)

        deformation, rate = gradients(self.position), gradients(self.velocity)
        volume, inverse = np.linalg.det(deformation), np.linalg.inv(deformation)
        # Velocity gradient.
        flow = rate @ inverse
        expansion = np.trace(flow, axis1=2, axis2=3)
        pressure = _BULK * (volume.mean(axis=1) - 1.0) + _BULK_VISCOSITY * (
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
        each = np.matmul(
            piola.transpose(0, 2, 1, 3).reshape(count, 3, -1), self._slopes.T) * self._weight
        force = np.zeros_like(self.position)
        for axis in range(3):
            force[:, axis] = -np.bincount(
                self._nodes.ravel(), each[:, axis].ravel(), minlength=len(force))
        return force
