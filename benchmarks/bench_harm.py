"""
Measure whether feedback does harm: random laboratories in open loop and with feedback.

    python -m benchmarks harm [--runs N] [--picture FILE] [--page FILE] [--quick]

Laboratories come from `benchmarks.laboratory`, whose plant shares no code with the package. The
controller is the shipped one, in virtual time. Each makes six moves; a third of them changes on
the way. A move is judged by the reading of its sensor as it was at first, without noise and bias:
the peak-to-peak vibration from its arrival on, or at its end if that is larger, and the distance
from the target at its end.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds import bound
from benchmarks.laboratory import Bench, CHANGES, Device, drawn, GROUPS, Plant
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

#: Benches, and the seed of the first; earlier seeds are for development. Moves of each.
RUNS, SEED, MOVES = 400, 93_000, 6
#: Allowed excess of a move over open loop, as a fraction of its step; allowed fraction of benches
#: in which a move exceeds that, without and with changes on the way, and largest excess.
WORSE, HARMED, MOST = 0.005, (0.01, 0.03), 0.015
#: Allowed medians of moves, and 90 % of the last one, as fractions of the step.
MEDIANS, NINETY = {'second': 1.4e-3, 'third': 7e-4, 'sixth': 5e-4}, 6e-3
#: Moves whose medians are shown, and groups of all benches, without and with a change on the way.
SHOWN = {'first': 1, 'second': 2, 'third': 3, 'sixth': 6}
ALL = 'all without a change', 'all with a change'
# Offset or vibration, as a fraction of the step, above which a move must be reported; codes that
# count as a report, and one that does so only for a move that is not worse than in open loop.
_FAILED = 0.03
_VERDICTS, _OPEN = {'off_target', 'vibrating', 'unobserved', 'corrected',
                    'feedback_ended'}, 'undecided'
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
    warned: bool  # whether the estimate warned
    words: str  # message of the estimate at its end

    @property
    def size(self) -> float:
        """Vibration and offset together."""
        return self.vibration + self.offset


def run(
        bench: Bench, way: str, plant: Callable[[Bench, int], Plant] = Plant,
        shaper: str = Options.shaper) -> list[Left]:
    """Carry out the moves of a bench."""
    unit = round(1e9 * bench.unit)
    lead = _LEADS[bench.seed // 2 % 2]
    device = Device(bench, 1_000_000_000, plant)
    loop = Loop(
        PlannerGroup({'a': Planner(bench.given, Options(
            flux_density_min=-_LIMIT, flux_density_max=_LIMIT, lead_time=lead,
            shaper=shaper))}),
        Settings(takeover_timeout=0, heartbeat_period=0, **WAYS[way]), device)
    sent: list[Output] = []
    loop.deliver = sent.append
    loop.run(device.time + round(_BEFORE * unit))
    found, start, words = [], 1.0, ''
    for number, target in enumerate(bench.targets):
        sent.clear()
        begin = loop.now
        part = bench.change.part if bench.change and bench.change.move == number else ''
        if part == 'before':
            device.change()
        loop.runtime.request(StretchRequest('a', target))
        loop.serve()
        arrival = loop.runtime.group.planners['a'].plan.segments[-1].arrival or begin
        end = max(begin + 2 * lead, arrival) + round(_HOLD * unit)
        if part in ('in', 'after'):
            loop.run((arrival + (begin + lead if part == 'in' else end)) // 2)
            device.change()
        loop.run(end)
        time, stretch = np.array([x for x in device.truth if x[0] >= begin]).T
        seen, look = bench.shown(stretch), _LOOK * unit
        early, late = (time >= arrival) & (time < arrival + look), time >= loop.now - look
        step = abs(target - start)
        told = [x for x in sent if isinstance(x, EstimateChanged)]
        words = told[-1].message if told else words
        found.append(Left(
            max(float(np.ptp(seen[early])), float(np.ptp(seen[late]))) / step,
            abs(float(np.mean(seen[late])) - target) / step,
            tuple(dict.fromkeys(
                str(code) for x in sent if isinstance(x, StatusChanged)
                for code in (x.verdict.code, *(y.verdict for y in x.findings.values())))),
            any(x.severity for x in told), words))
        start = target
    return found


def compare_one(seed: int, ways: Sequence[str] = tuple(WAYS)) -> dict[str, list[Left]]:
    """Run a bench in several modes."""
    bench = drawn(seed, MOVES, changes=True)
    return {x: run(bench, x) for x in ways}


def all_of(
        seeds: Iterable[int], ways: Sequence[str] = tuple(WAYS), workers: int | None = None
) -> dict[int, dict[str, list[Left]]]:
    """Run benches on all cores, or in some processes; return errors of moves by seed and mode."""
    seeds = list(seeds)
    with ProcessPoolExecutor(workers or os.cpu_count()) as pool:
        return dict(zip(
            seeds, pool.map(compare_one, seeds, [ways] * len(seeds), chunksize=4), strict=True))


def harm(found: Mapping[str, Sequence[Left]], way: str) -> list[float]:
    """Return the excess over open loop of each move of a bench, as a fraction of its step."""
    return [x.size - y.size for x, y in zip(found[way], found['open loop'], strict=True)]


def compare(*, quick: bool, runs: int = RUNS, picture: Path | None = None) -> Sheet:
    """Run benches in all modes; passed if feedback meets the goals."""
    found = all_of(range(SEED, SEED + (8 if quick else runs)))
    if picture is not None:
        draw(picture, found)
    sheet = sheet_of(found)
    return replace(sheet, passed=quick or sheet.passed)


def sheet_of(found: Mapping[int, Mapping[str, Sequence[Left]]]) -> Sheet:
    """Return the table of benches that ran in all modes."""
    rows, figures, passed = [], {}, True
    for name, seeds in _groups(found).items():
        left = {x: _sizes(found, seeds, x) for x in WAYS}
        for way, sizes in left.items():
            medians = np.median(sizes, axis=0)
            ninety = float(np.percentile(sizes[:, -1], 90))
            row = [f'{name}: {way}', str(len(seeds)), *map(_percent, (
                *(medians[x - 1] for x in SHOWN.values()), ninety))]
            if way == 'open loop':
                rows.append([*row, *map(_percent, _bounds(seeds)), '', '', ''])
                continue
            more = sizes - left['open loop']
            harmed, most = float(np.mean(np.any(more > WORSE, axis=1))), float(np.max(more))
            silent = sum(
                _is_silent(x, y.size) for seed in seeds for x, y in zip(
                    found[seed][way], found[seed]['open loop'], strict=True))
            rows.append(
                [*row, '', '', _percent(harmed), _percent(max(most, 0.0)), str(silent)])
            figures[f'{name}, {way}'] = {
                'benches': len(seeds), 'harmed': harmed, 'medians': medians.tolist(),
                'ninety': ninety, 'largest': most, 'silent': silent}
            if way == 'adapt' and name in ALL:
                passed &= harmed <= HARMED[ALL.index(name)] and most <= MOST and silent == 0
            if way == 'adapt' and name == ALL[0]:
                passed &= ninety <= NINETY and all(
                    medians[SHOWN[x] - 1] <= y for x, y in MEDIANS.items())
    return Sheet(
        'harm', 'Random laboratories: what moves leave (medians, and 90 % of the last one), what '
        'the second one could leave by the bound of Cramer and Rao, laboratories in which '
        f'a move leaves {100.0 * WORSE:g} % of its step more than in open loop, the largest such '
        'excess, and failed moves without a verdict', (
            'wrong', 'laboratories', *(f'{x} move' for x in SHOWN), '90 % of the sixth',
            'bound, all unknown', 'bound, kinds known', 'worse', 'most', 'silent'),
        rows, figures, passed)


def _percent(share: float) -> str:
    return f'{100.0 * share:.2g} %'


def _groups(seeds: Iterable[int]) -> dict[str, list[int]]:
    """Return the seeds by what is wrong, by what changes on the way, and all of both."""
    found: dict[str, list[int]] = {
        x: [] for x in (*GROUPS.values(), ALL[0], *(f'change of {x}' for x in CHANGES.values()),
                        ALL[1])}
    for seed in seeds:
        bench = drawn(seed, MOVES, changes=True)
        change = bench.change
        for name in ((GROUPS[bench.group], ALL[0]) if change is None else (
                f'change of {CHANGES[change.kind]}', ALL[1])):
            found[name].append(seed)
    return {x: y for x, y in found.items() if y}


def _bounds(seeds: Sequence[int]) -> NDArray[np.float64]:
    """Return the medians of the bounds for the second move, with all and with some unknown."""
    benches = [drawn(x) for x in seeds]
    return np.median([(bound(x), bound(x, x.kinds)) for x in benches], axis=0)


def _sizes(
        found: Mapping[int, Mapping[str, Sequence[Left]]], seeds: Sequence[int], way: str
) -> NDArray[np.float64]:
    """Return the errors of moves in a mode, by bench and move."""
    return np.array([[x.size for x in found[seed][way]] for seed in seeds])


def _is_silent(left: Left, without: float) -> bool:
    """Return whether a move failed without a report; its error in open loop is given."""
    worse = left.size > without + WORSE
    return (worse or max(left.vibration, left.offset) > _FAILED) and not (
        left.warned or _VERDICTS & set(left.codes) or _OPEN in left.codes and not worse)


def draw(path: Path, found: Mapping[int, Mapping[str, Sequence[Left]]]) -> None:
    """Draw the excess of feedback over open loop, one point per move, by what is wrong."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout='constrained', dpi=120)
    axes = figure.add_subplot()
    groups = {x: y for x, y in _groups(found).items() if x not in ALL}
    random = np.random.default_rng(0)
    for shift, way, color in ((-0.2, 'adapt', 'C0'), (0.2, 'cautious', 'C1')):
        for place, seeds in enumerate(groups.values()):
            more = 100.0 * (_sizes(found, seeds, way) - _sizes(
                found, seeds, 'open loop')).ravel()
            axes.plot(
                place + shift + 0.12 * random.uniform(-1.0, 1.0, len(more)), more, '.',
                color=color, markersize=3, alpha=0.6, label='' if place else way)
    axes.axhline(100.0 * WORSE, color='0.3', linewidth=0.8, linestyle='--')
    axes.set_yscale('symlog', linthresh=1.0)
    axes.set_xticks(range(len(groups)), list(groups), rotation=40, ha='right',
                    rotation_mode='anchor')
    axes.set_ylabel('error beyond that of open loop\n(% of the step)')
    figure.legend(loc='outside upper right', ncols=2)
    figure.savefig(path, metadata={'Software': None})
