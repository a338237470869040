"""
Whether feedback does harm: random laboratories, each once in open loop and once with feedback.

    python -m benchmarks harm [--runs N] [--picture FILE] [--page FILE] [--quick]

Laboratories come from `benchmarks.laboratory`, whose plant shares nothing with the package. The
controller is the shipped one, in virtual time. A move is judged as its sensor would read it
without noise and bias: vibration from peak to peak from its arrival on, or at its end if that is
more, and the distance from the target at its end.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds import bound
from benchmarks.laboratory import Bench, Device, drawn, GROUPS
from benchmarks.sheet import Sheet
from hmsa_ros.control.loop import Loop
from hmsa_ros.control.records import EstimateChanged, Output, Settings, StatusChanged, Target
from hmsa_ros.planning.group import PlannerGroup
from hmsa_ros.planning.planner import Options, Planner

#: Benches, and the seed of the first; those before it are for development.
RUNS, SEED = 400, 90_000
#: What a move may leave more than in open loop, as a share of its step, the share of benches in
#: which one does so, and the median of the second move.
WORSE, HARMED, SECOND = 0.005, 0.01, 0.003
# Offset or vibration, as a share of the step, from which on a move is to have a verdict, and those
# that count.
_FAILED = 0.03
_VERDICTS = {'off_target', 'vibrating', 'undecided', 'unobserved', 'corrected',
             'feedback_ended'}
# Largest field in T, and how far ahead commands are sent, in ns.
_LIMIT, _LEADS = 0.5, (2_000_000, 50_000_000)
# Units of time before the first move, after a move, and of a look at the vibration.
_BEFORE, _HOLD, _LOOK = 15.0, 22.0, 3.0
#: The ways to control: open loop, feedback, and cautious feedback.
WAYS: dict[str, dict[str, Any]] = {
    'open loop': {'feedback': 'off'}, 'adapt': {'feedback': 'adapt'},
    'cautious': {'feedback': 'adapt', 'feedback_cautious': True}}


@dataclass(frozen=True)
class Left:
    """What a move leaves, as shares of its step, and what was reported of it."""

    vibration: float
    offset: float
    codes: tuple[str, ...]  # of verdicts, and of what was measured until then
    words: str  # the sentence of the estimate at its end

    @property
    def size(self) -> float:
        """Vibration and offset together."""
        return self.vibration + self.offset


def run(bench: Bench, way: str) -> list[Left]:
    """Carry out the moves of a bench."""
    unit = round(1e9 * bench.unit)
    lead = _LEADS[bench.seed // 2 % 2]
    device = Device(bench, 1_000_000_000)
    loop = Loop(
        PlannerGroup({'a': Planner(bench.given, Options(
            flux_density_min=-_LIMIT, flux_density_max=_LIMIT, lead_time=lead))}),
        Settings(takeover_timeout=0, heartbeat_period=0, **WAYS[way]), device)
    told: list[Output] = []
    loop.deliver = told.append
    loop.run(device.time + round(_BEFORE * unit))
    found, start, words = [], 1.0, ''
    for target in bench.targets:
        told.clear()
        begin = loop.now
        loop.runtime.request(Target('a', target))
        loop.serve()
        arrival = loop.runtime.group.planners['a'].plan.segments[-1].arrival or begin
        loop.run(max(begin + 2 * lead, arrival) + round(_HOLD * unit))
        time, stretch = np.array([x for x in device.truth if x[0] >= begin]).T
        seen, look = bench.shown(stretch), _LOOK * unit
        early, late = (time >= arrival) & (time < arrival + look), time >= loop.now - look
        step = abs(target - start)
        words = next((x.message for x in reversed(told) if isinstance(x, EstimateChanged)), words)
        found.append(Left(
            max(float(np.ptp(seen[early])), float(np.ptp(seen[late]))) / step,
            abs(float(np.mean(seen[late])) - target) / step,
            tuple(dict.fromkeys(
                str(code) for x in told if isinstance(x, StatusChanged)
                for code in (x.verdict.code, *(y.verdict for y in x.findings.values())))),
            words))
        start = target
    return found


def compare_one(seed: int, ways: Sequence[str] = tuple(WAYS)) -> dict[str, list[Left]]:
    """Run a bench in several ways."""
    bench = drawn(seed)
    return {x: run(bench, x) for x in ways}


def all_of(
        seeds: Iterable[int], ways: Sequence[str] = tuple(WAYS)
) -> dict[int, dict[str, list[Left]]]:
    """Run benches on all cores; return what moves leave by seed and way."""
    seeds = list(seeds)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(
            seeds, pool.map(compare_one, seeds, [ways] * len(seeds), chunksize=4), strict=True))


def harm(found: Mapping[str, Sequence[Left]], way: str) -> list[float]:
    """Return how much more than open loop each move of a bench leaves, as a share of its step."""
    return [x.size - y.size for x, y in zip(found[way], found['open loop'], strict=True)]


def compare(*, quick: bool, runs: int = RUNS, picture: Path | None = None) -> Sheet:
    """Run benches in all ways; passed if the goals hold for both kinds of feedback."""
    found = all_of(range(SEED, SEED + (8 if quick else runs)))
    groups: dict[str, list[int]] = {x: [] for x in GROUPS}
    bounds = {}
    for seed in found:
        bench = drawn(seed)
        groups[bench.group].append(seed)
        bounds[seed] = bound(bench), bound(bench, bench.kinds)
    rows, figures, passed = [], {}, True
    for group, seeds in [*groups.items(), ('all', list(found))]:
        if not seeds:
            continue
        left = {x: _sizes(found, seeds, x) for x in WAYS}
        least = np.array([bounds[x] for x in seeds])
        row = [GROUPS.get(group, group), str(len(seeds)), *(
            f'{100.0 * np.median(x):.2g} %' for x in (left['open loop'][:, 1], *least.T))]
        for way in list(WAYS)[1:]:
            more = left[way] - left['open loop']
            harmed = float(np.mean(np.any(more > WORSE, axis=1)))
            second = float(np.median(left[way][:, 1]))
            silent = sum(_is_silent(x) for seed in seeds for x in found[seed][way])
            row += [f'{100.0 * second:.2g} %', f'{100.0 * harmed:.2g} %',
                    f'{100.0 * max(float(np.max(more)), 0.0):.2g} %', str(silent)]
            figures[f'{group}, {way}'] = {
                'benches': len(seeds), 'harmed': harmed, 'second': second,
                'largest': float(np.max(more)), 'silent': silent}
            if group == 'all':
                passed &= harmed <= HARMED and second <= SECOND and silent == 0
        rows.append(row)
    if picture is not None:
        draw(picture, found, groups)
    return Sheet(
        'harm', 'Random laboratories: what the second move leaves (median) and could leave by the '
        'bound of Cramer and Rao, laboratories in which '
        f'a move leaves {100.0 * WORSE:g} % of its step more than in open loop, the largest such '
        'excess, and failed moves without a verdict', (
            'wrong', 'laboratories', 'open loop: second move', 'bound, all unknown',
            'bound, kinds known', *(
                f'{way}: {x}' for way in list(WAYS)[1:]
                for x in ('second move', 'worse', 'most', 'silent'))),
        rows, figures, quick or passed)


def _sizes(
        found: Mapping[int, Mapping[str, Sequence[Left]]], seeds: Sequence[int], way: str
) -> NDArray[np.float64]:
    """Return what moves leave in a way, by bench and move."""
    return np.array([[x.size for x in found[seed][way]] for seed in seeds])


def _is_silent(left: Left) -> bool:
    """Return whether a move failed and nothing was reported of it."""
    return max(left.vibration, left.offset) > _FAILED and not _VERDICTS & set(left.codes)


def draw(
        path: Path, found: Mapping[int, Mapping[str, Sequence[Left]]],
        groups: Mapping[str, Sequence[int]]) -> None:
    """Draw what feedback leaves more than open loop, each move a point, by what is wrong."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout='constrained', dpi=120)
    axes = figure.add_subplot()
    random = np.random.default_rng(0)
    for shift, way, color in ((-0.2, 'adapt', 'C0'), (0.2, 'cautious', 'C1')):
        for place, seeds in enumerate(groups.values()):
            more = 100.0 * (_sizes(found, seeds, way) - _sizes(
                found, seeds, 'open loop')).ravel() if seeds else np.zeros(0)
            axes.plot(
                place + shift + 0.12 * random.uniform(-1.0, 1.0, len(more)), more, '.',
                color=color, markersize=3, alpha=0.6, label='' if place else way)
    axes.axhline(100.0 * WORSE, color='0.3', linewidth=0.8, linestyle='--')
    axes.set_yscale('symlog', linthresh=1.0)
    axes.set_xticks(range(len(groups)), [GROUPS[x].replace(' of ', '\nof ') for x in groups],
                    rotation=30, ha='right')
    axes.set_ylabel('left more than in open loop,\n% of the step')
    figure.legend(loc='outside upper right', ncols=2)
    figure.savefig(path, metadata={'Software': None})
