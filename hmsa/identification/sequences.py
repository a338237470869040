"""Repeats of a sequence from recorded runs, and the learnt sequence."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification.learning import learn, Learnt, SequenceRepeat, TargetWindow
from hmsa.interfaces.outcome import LEVELS
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import ROUNDED, Run, setpoints_of


def learn_from(runs: Sequence[Run]) -> tuple[Learnt, list[TargetWindow]]:
    """
    Learn from runs of one sequence.

    Parameters
    ----------
    runs : sequence of Run
        Runs in order: the first one with setpoints, each further one with the levels learnt from
        the previous ones.

    Returns
    -------
    (Learnt, list of Target)
        The next levels, and the setpoints, in s from the first level.

    Raises
    ------
    BadInputError
        If there are no setpoints, or a run does not begin without a field.

    """
    first = runs[0]
    begins = [_begin(x) for x in runs]
    given = first.outcomes and all(x.asked == LEVELS for x in first.outcomes)
    requested = [] if given else [x.setpoint for x in setpoints_of(first)]
    if not requested:
        raise BadInputError(
            f'{first.path} has no setpoints: expected the run of a sequence as it was planned '
            'first, such as of hmsa run 1.10:0.5 1.00:0.5')
    last = min(int(x.time[-1]) - y for x, y in zip(runs, begins, strict=True))
    ends = [x.begins for x in requested[1:]] + [
        requested[-1].end if requested[-1].end is not None else begins[0] + last]
    targets = [
        TargetWindow(x.target, max((x.begins - begins[0]) / NANOSECONDS, 0.0),
               (end - begins[0]) / NANOSECONDS,
               None if x.arrival is None else (x.arrival - begins[0]) / NANOSECONDS)
        for x, end in zip(requested, ends, strict=True)]
    low, high = (first.number('planner.flux_density_max') or 0.5) * np.array((-1.0, 1.0))
    return learn(
        [_trial(x, begin) for x, begin in zip(runs, begins, strict=True)], targets,
        first.planner, (float(low), float(high))), targets


def _begin(run: Run) -> int:
    """Return the time in ns at which the first level of a run took effect."""
    largest = max((abs(x.flux_density) for x in run.levels), default=0.0)
    asked = min((x.setpoint.begins for x in run.outcomes), default=int(run.time[0]))
    for x in run.levels:
        # Smaller levels are due to rounding, or compensate the remanence of a core.
        if abs(x.flux_density) > ROUNDED * largest:
            if x.stamp < asked:
                break
            return x.stamp
    raise BadInputError(
        f'{run.path} does not begin at rest without a field: expected a sequence that does, and '
        'levels that took effect')


def _trial(run: Run, begin: int) -> SequenceRepeat:
    """Return a repeat, with times from its first level."""
    since = (run.time - begin) / NANOSECONDS
    levels = [x for x in run.levels if x.stamp >= begin]
    times = np.array([(x.stamp - begin) / NANOSECONDS for x in levels])
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(times) > 0.0, True)
    seen = (since >= 0.0) & np.isfinite(run.stretch)
    return SequenceRepeat(
        since[seen], run.stretch[seen], times[keep],
        np.array([x.flux_density for x in levels])[keep])


def sequence_text(found: Learnt, targets: Sequence[TargetWindow], runs: Sequence[Path]) -> str:
    """Return a learnt sequence as YAML for ``hmsa run --levels``."""
    end = targets[-1].end
    rows = [*zip(found.level_times.tolist(), found.levels.tolist(), strict=True),
            (end, float(found.levels[-1]))]
    return '\n'.join([
        f'# by hmsa learn, from {", ".join(map(str, runs))}',
        'setpoints:  # stretch, from and until, in s',
        *(f'  - [{x.stretch:.9g}, {x.begin:.9f}, {x.end:.9f}]' for x in targets),
        'levels:  # time in s, and flux density in T from then on',
        *(f'  - [{x:.9f}, {y:.9g}]' for x, y in rows)]) + '\n'


def levels_in(path: Path) -> list[tuple[float, float]]:
    """
    Return times in s and levels in T of a learnt sequence.

    Raises
    ------
    BadInputError
        If the file cannot be read, or is no learnt sequence.

    """
    import yaml

    try:
        found = yaml.safe_load(path.read_text(encoding='utf-8'))
        rows = [(float(x), float(y)) for x, y in found['levels']]
        if not rows or not np.all(np.isfinite(rows)) or np.any(
                np.diff([x for x, _ in rows]) <= 0.0):
            raise ValueError
    except OSError as error:
        raise BadInputError(f'cannot read {path}: {error.strerror}') from error
    except (yaml.YAMLError, KeyError, TypeError, ValueError, UnicodeDecodeError) as error:
        raise BadInputError(
            f'{path} is no learnt sequence: expected levels, a list of [time in s, flux density '
            'in T] at rising times, as hmsa learn writes it') from error
    return rows
