"""
Inject faults into running nodes and compare the response with the expected one.

Each row starts real processes in a ROS domain of its own and injects its fault. It judges from the
plant's samples and the changes of flux density that the plant reports, not from logs. The
expected response stands beside the row's code, written before the run; the run fails if a row
does not meet it.
"""

from collections.abc import Sequence
import sys
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.faults.table import inject, markdown, Outcome
from benchmarks.measure import ros_domain


def run(
        console: Console, *, only: Sequence[str] = (),
        quick: bool = False) -> tuple[list[Outcome], int]:
    """Inject the faults whose keys start so; print the table; return outcomes and exit status."""
    from benchmarks.faults.rows import FAULTS, QUICK

    faults = [
        x for x in FAULTS if (not only or x.key.startswith(tuple(only)))
        and (not quick or only or x.key in QUICK)]
    first = ros_domain()
    outcomes: list[Outcome] = []
    for number, fault in enumerate(faults):
        print(f'{number + 1}/{len(faults)} {fault.key}', end=': ', file=sys.stderr, flush=True)
        # A new domain, so that no process waits for the lease of a killed one.
        outcomes.append(inject(fault, 1 + (first - 1 + number) % 101))
        seen = outcomes[-1].seen
        print(f'{"met" if seen.met else "NOT MET"} ({seen.figure}): {seen.text}',
              file=sys.stderr, flush=True)
    table = Table(title='Faults injected into running nodes', title_justify='left')
    for name in ('fault', 'how it is made', 'expected', 'seen', 'residual or loss', ''):
        table.add_column(name)
    for row in outcomes:
        table.add_row(
            row.fault.name, row.fault.how, row.fault.expected, row.seen.text, row.seen.figure,
            'met' if row.seen.met else 'NOT MET', end_section=True)
    console.print(table)
    failed = [x.fault.key for x in outcomes if not x.seen.met]
    console.print(f'{len(outcomes) - len(failed)} of {len(outcomes)} as expected'
                  + (f'; not: {", ".join(failed)}' if failed else ''))
    return outcomes, 1 if failed else 0


def record(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return the table for a JSON file, one dict per row."""
    return [
        {'key': x.fault.key, 'fault': x.fault.name, 'how': x.fault.how,
         'expected': x.fault.expected, 'seen': x.seen.text, 'figure': x.seen.figure,
         'met': x.seen.met} for x in outcomes]


def page_text(outcomes: Sequence[Outcome]) -> str:
    """Return the table for a page of the documentation, in Markdown."""
    return markdown(outcomes)
