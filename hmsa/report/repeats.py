"""Statistics of repeated sequences: vibration and steady-state error."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.judge.records import Finding
from hmsa.table import Column, Table


def repeats_in(folder: Path) -> list[Path]:
    """Return the bags of the repeats that ``hmsa run --repeat`` wrote in a folder, in order."""
    if (folder / 'metadata.yaml').exists() or not folder.is_dir():
        return []
    return sorted((x for x in folder.glob('*/run') if x.parent.name.isdecimal()),
                  key=lambda x: int(x.parent.name))


def statistics(each: Sequence[Sequence[Finding]]) -> list[dict[str, Any]]:
    """
    Return statistics of vibration and steady-state error, in % of the step, by setpoint.

    They are the mean, the standard deviation, and the value of the largest size.
    """
    found = []
    for group in zip(*each, strict=False):
        row: dict[str, Any] = {
            'joint': group[0].setpoint.joint, 'setpoint': group[0].setpoint.number,
            'target': group[0].setpoint.target, 'repeats': len(group),
            'arrived': sum(x.arrived for x in group)}
        for name in ('vibration', 'offset'):
            values = np.array([x.setpoint.percent(getattr(x, name)) for x in group])
            values = values[np.isfinite(values)]
            row[f'{name}_percent'] = {
                'mean': float(np.mean(values)) if len(values) else None,
                'std': float(np.std(values, ddof=1)) if len(values) > 1 else None,
                'largest': float(values[np.argmax(np.abs(values))]) if len(values) else None}
        found.append(row)
    return found


def statistics_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """
    Return a table of the statistics of one or more runs, by setpoint and label.

    Raises
    ------
    BadInputError
        If no run has a setpoint.

    """
    rows = []
    for place in range(max(map(len, runs.values()), default=0)):
        for label, found in runs.items():
            if place < len(found):
                x = found[place]
                figures = [x[f'{y}_percent'][z] for y in ('vibration', 'offset')
                           for z in ('mean', 'std', 'largest')]
                rows.append((
                    f'{x["joint"]} {x["setpoint"]}'.strip(), *([label] if len(runs) > 1 else []),
                    x['target'], f'{x["arrived"]} of {x["repeats"]}',
                    *(math.nan if y is None else y for y in figures)))
    if not rows:
        raise BadInputError(
            f'{", ".join(runs)} have no setpoint: expected repeats of a sequence of setpoints')
    return Table(
        (Column('setpoint'), *([Column('run')] if len(runs) > 1 else []), Column('target'),
         Column('arrived'), *(
            Column(f'{y}{z}', '', '.3g') for y in ('vibration', 'offset')
            for z in ('', ' std', ' max'))), tuple(rows),
        'over the repeats: mean, standard deviation and largest; in % of the step')
