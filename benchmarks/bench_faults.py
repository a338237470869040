"""
Inject faults into running nodes and compare the response with the expected one.

Each row starts real processes in a ROS domain of its own and injects its fault. It judges from the
plant's samples and the changes of flux density that the plant reports, not from logs. The
expected response stands beside the row's code, written before the run; the run fails if a row
does not meet it.
"""

from collections.abc import Sequence
import sys

from benchmarks.faults.table import Fault, inject, Seen
from benchmarks.measure import ros_domain
from benchmarks.sheet import Sheet


def compare(*, quick: bool, only: Sequence[str] = ()) -> Sheet:
    """Inject the faults whose keys start so, and print what is seen of each."""
    from benchmarks.faults.rows import FAULTS, QUICK

    faults = [
        x for x in FAULTS if (not only or x.key.startswith(tuple(only)))
        and (not quick or only or x.key in QUICK)]
    first = ros_domain()
    found: list[Seen] = []
    for number, fault in enumerate(faults):
        print(f'{number + 1}/{len(faults)} {fault.key}', end=': ', file=sys.stderr, flush=True)
        # A new domain, so that no process waits for the lease of a killed one.
        seen = inject(fault, 1 + (first - 1 + number) % 101)
        found.append(seen)
        print(f'{"met" if seen.met else "NOT MET"} ({seen.figure}): {seen.text}',
              file=sys.stderr, flush=True)
    return sheet(faults, found)


def sheet(faults: Sequence[Fault], found: Sequence[Seen]) -> Sheet:
    """Return the table, with what was seen where it is unexpected; passed if it never is."""
    rows = [*zip(faults, found, strict=True)]
    failed = [x.key for x, y in rows if not y.met]
    return Sheet(
        'faults', 'Faults injected into running nodes',
        ('fault', 'how', 'expected', 'residual or loss'),
        [(x.name, x.how, x.expected + ('' if y.met else f'; **not met**: {y.text}'), y.figure)
         for x, y in rows],
        {'rows': [{
            'key': x.key, 'fault': x.name, 'how': x.how, 'expected': x.expected, 'seen': y.text,
            'figure': y.figure, 'met': y.met} for x, y in rows]},
        not failed, remarks=[f'{len(rows) - len(failed)} of {len(rows)} as expected'
                             + (f'; not: {", ".join(failed)}' if failed else '')])
