"""
A compressible block against finite elements: statics, and the frequency of the first mode.

    python -m benchmarks compressible [--quick]

At rest, a free block in a uniform field deforms uniformly, so that one degree of freedom is exact
there. In motion its faces bulge: frequencies agree with the modes of `hmsa.model.continuum`, which
`mount='free'` takes, and not with uniform deformation. Frequencies on elements are extrapolated
from two meshes, since their error is that of the square of the mesh width.
"""

import math

import numpy as np

from benchmarks.block_elements import Block
from benchmarks.sheet import Sheet
from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.model.equations import Array, elastic_force
from hmsa.model.law import natural_frequency

#: H/L, and elements along x, y and z of the coarser mesh.
SHAPES = {0.5: (5, 5, 3), 1.0: (4, 4, 4), 2.0: (3, 3, 6)}
#: Bulk over shear modulus.
RATIOS = (3.0, 10.0, 100.0, 1000.0)
#: Stretches at rest, of which the first is that without a field.
STRETCHES = (1.0, 0.9, 1.1, 1.2)
_J_LIM = 5.0
# Least share of the first mode where another one may have more.
_STRONG = 0.05
# Largest deviations in %: of the stretch at rest in units of the step, of the first frequency at
# any of the stretches.
_STATIC, _FIRST = 0.2, 0.5


def compare(*, quick: bool) -> Sheet:
    """Return deviations of the model from finite elements."""
    shapes = {0.5: (3, 3, 2)} if quick else SHAPES
    rows, figures, passed = [], [], True
    for shape, cells in shapes.items():
        for ratio in RATIOS[1:2] if quick else RATIOS:
            static, off = _compared(shape, ratio, cells)
            figures.append({'shape': shape, 'bulk_ratio': ratio, 'static': static, **off})
            free = off['free']
            passed &= static <= _STATIC and max(map(abs, free)) <= _FIRST
            rows.append([
                f'{shape:g}, {ratio:g}', f'{static:.0e}', f'{off["uniform"][0]:+.1f}',
                f'{off["constant volume"][0]:+.1f}', *(f'{x:+.2f}' for x in free)])
    return Sheet(
        'compressible',
        'Deviation from finite elements in %: of the stretch at rest, largest of three, in units '
        'of the step; of the first frequency about rest without a field, for a block that deforms '
        'uniformly, and with the modes of constant volume; with its own modes, also about other '
        'stretches',
        ('H/L, K/G', 'rest', 'uniform', 'constant volume',
         *(f'`free`, {x:g}' for x in STRETCHES)), rows, {'rows': figures}, passed)


def _compared(
        shape: float, ratio: float,
        cells: tuple[int, int, int]) -> tuple[float, dict[str, list[float]]]:
    """Return deviations in %: of the stretch at rest, and of frequencies at `STRETCHES`."""
    with unquestioned():  # of flat blocks
        paper = Actuator(half_thickness=0.01 * shape, bulk_ratio=ratio, chain_limit=_J_LIM)
        models = {'uniform': paper, 'free': paper.replace(mount='free'),
                  'constant volume': paper.replace(mount='free', bulk_ratio=math.inf)}
    x, y, z = cells
    coarse, fine = (Block(shape, _J_LIM, 0.0, n, bulk=ratio) for n in (
        cells, (2 * x, 2 * y, 2 * z)))
    static, at_rest = 0.0, [math.nan, math.nan]
    off: dict[str, list[float]] = {name: [] for name in models}
    for stretch in STRETCHES:
        coarse.settle(float(elastic_force(stretch, paper.model.material)))
        fine.deform(coarse.stretch, coarse.side)
        if stretch != 1.0:
            static = max(static, 100.0 * abs(coarse.stretch - stretch) / abs(stretch - 1.0))
        found = [_first(*mesh.modes(), x) for mesh, x in zip((coarse, fine), at_rest, strict=True)]
        if stretch == 1.0:
            at_rest = found
        exact = math.sqrt((4.0 * found[1] ** 2 - found[0] ** 2) / 3.0)
        for name, model in models.items():
            off[name].append(100.0 * (_frequency(model, stretch) / exact - 1.0))
    return static, off


def _first(frequencies: Array, shares: Array, at_rest: float) -> float:
    """Return the frequency of the first mode: that with the largest share at rest."""
    if math.isnan(at_rest):
        return float(frequencies[np.argmax(shares)])
    strong = frequencies[shares > _STRONG]
    return float(strong[np.argmin(abs(strong - at_rest))])


def _frequency(actuator: Actuator, stretch: float) -> float:
    """Return the natural frequency about a stretch, in units of sqrt(G/rho)/L."""
    block = actuator.block
    unit = block.half_length * math.sqrt(block.density / block.shear_modulus)
    return natural_frequency(
        stretch, block.nondimensional.packed) * unit / block.time_unit
