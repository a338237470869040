"""
Measure whether feedback does harm: random laboratories in open loop and with feedback.

    python -m benchmarks harm [--runs N] [--picture FILE] [--page FILE] [--quick]

Laboratories come from `benchmarks.laboratory`, whose plant shares no code with the package. The
controller is the shipped one, in virtual time. A move is judged by its sensor's reading without
noise and bias: the peak-to-peak vibration from its arrival on, or at its end if that is larger,
and the distance from the target at its end.
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
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import (
    EstimateChanged,
    Output,
    Settings,
    StatusChanged,
    StretchRequest,
)

#: Benches, and the seed of the first; earlier seeds are for development.
RUNS, SEED = 400, 90_000
#: Allowed excess of a move over open loop, as a fraction of its step; allowed fraction of benches
#: in which a move exceeds that; allowed median of the second move.
WORSE, HARMED, SECOND = 0.005, 0.01, 0.003
# Offset or vibration, as a fraction of the step, above which a move must be reported, and the
# codes that count as a report.
_FAILED = 0.03
_VERDICTS = {'off_target', 'vibrating', 'undecided', 'unobserved', 'corrected',
             'feedback_ended'}
# Largest field in T, and how far ahead commands are sent, in ns.
_LIMIT, _LEADS = 0.5, (2_000_000, 50_000_000)
# Duration before the first move, of a hold, and of a window for the vibration, in time scales.
_BEFORE, _HOLD, _LOOK = 15.0, 22.0, 3.0
#: Control modes: open loop, feedback, and cautious feedback.
WAYS: dict[str, dict[str, Any]] = {
    'open loop': {'feedback': 'off'}, 'adapt': {'feedback': 'adapt'},
    'cautious': {'feedback': 'cautious'}}


@dataclass(frozen=True)
class Left:
    """The errors a move leaves, as fractions of its step, and what was reported about it."""

    vibration: float
    offset: float
    codes: tuple[str, ...]  # of verdicts, and of observations up to then
    words: str  # message of the estimate at its end

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
    sent: list[Output] = []
    loop.deliver = sent.append
    loop.run(device.time + round(_BEFORE * unit))
    found, start, words = [], 1.0, ''
    for target in bench.targets:
        sent.clear()
        begin = loop.now
        loop.runtime.request(StretchRequest('a', target))
        loop.serve()
        arrival = loop.runtime.group.planners['a'].plan.segments[-1].arrival or begin
        loop.run(max(begin + 2 * lead, arrival) + round(_HOLD * unit))
        time, stretch = np.array([x for x in device.truth if x[0] >= begin]).T
        seen, look = bench.shown(stretch), _LOOK * unit
        early, late = (time >= arrival) & (time < arrival + look), time >= loop.now - look
        step = abs(target - start)
        words = next((x.message for x in reversed(sent) if isinstance(x, EstimateChanged)), words)
        found.append(Left(
            max(float(np.ptp(seen[early])), float(np.ptp(seen[late]))) / step,
            abs(float(np.mean(seen[late])) - target) / step,
            tuple(dict.fromkeys(
                str(code) for x in sent if isinstance(x, StatusChanged)
                for code in (x.verdict.code, *(y.verdict for y in x.findings.values())))),
            words))
        start = target
    return found


def compare_one(seed: int, ways: Sequence[str] = tuple(WAYS)) -> dict[str, list[Left]]:
    """Run a bench in several modes."""
    bench = drawn(seed)
    return {x: run(bench, x) for x in ways}


def all_of(
        seeds: Iterable[int], ways: Sequence[str] = tuple(WAYS)
) -> dict[int, dict[str, list[Left]]]:
    """Run benches on all cores; return the errors of moves by seed and mode."""
    seeds = list(seeds)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(
            seeds, pool.map(compare_one, seeds, [ways] * len(seeds), chunksize=4), strict=True))


def harm(found: Mapping[str, Sequence[Left]], way: str) -> list[float]:
    """Return the excess over open loop of each move of a bench, as a fraction of its step."""
    return [x.size - y.size for x, y in zip(found[way], found['open loop'], strict=True)]


def compare(*, quick: bool, runs: int = RUNS, picture: Path | None = None) -> Sheet:
    """Run benches in all modes; passed if both kinds of feedback meet the goals."""
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
    """Return the errors of moves in a mode, by bench and move."""
    return np.array([[x.size for x in found[seed][way]] for seed in seeds])


def _is_silent(left: Left) -> bool:
    """Return whether a move failed without a report."""
    return max(left.vibration, left.offset) > _FAILED and not _VERDICTS & set(left.codes)


def draw(
        path: Path, found: Mapping[int, Mapping[str, Sequence[Left]]],
        groups: Mapping[str, Sequence[int]]) -> None:
    """Draw the excess of feedback over open loop, one point per move, by kind of mismatch."""
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
