"""The table of faults: one row per fault, with the expected and the actual response."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
import tempfile

from benchmarks.faults.rig import Rig
from hmsa.errors import HmsaError


@dataclass(frozen=True)
class Seen:
    """The response to a fault."""

    text: str
    figure: str  # residual as a fraction of the step, or loss with its unit
    met: bool  # whether the response is as expected


@dataclass(frozen=True)
class Fault:
    """A fault to inject."""

    key: str  # name on the command line
    name: str  # description of the fault
    how: str  # how it is injected
    expected: str  # required response
    inject: Callable[[Rig], Seen]  # injects it in a rig of its own


@dataclass(frozen=True)
class Outcome:
    """A row of the table."""

    fault: Fault
    seen: Seen


def inject(fault: Fault, domain: int) -> Outcome:
    """
    Inject one fault into real processes of a ROS domain.

    A fault that stops the rig counts as a failure, and the reason is reported. An unhandled
    exception in the output of any process is always a failure.
    """
    with tempfile.TemporaryDirectory(prefix='hmsa_faults_') as folder:
        rig = Rig(Path(folder), domain)
        try:
            with rig:
                seen = fault.inject(rig)
        except HmsaError as error:
            seen = Seen(f'{error}{rig.last_words()}', '-', met=False)
        traces = rig.traces()
        if traces:
            seen = Seen(
                f'{seen.text}; {len(traces)} unhandled exceptions, the first in the {traces[0]}',
                seen.figure, met=False)
    return Outcome(fault, seen)


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the table for a documentation page; the response is shown only if unexpected."""
    head = ('fault', 'how', 'expected', 'residual or loss')
    lines = ['| ' + ' | '.join(head) + ' |', '|' + ' --- |' * len(head)]
    for row in outcomes:
        expected = row.fault.expected + (
            '' if row.seen.met else f'; **not met**: {row.seen.text}')
        cells = (row.fault.name, row.fault.how, expected, row.seen.figure)
        lines.append('| ' + ' | '.join(x.replace('|', '\\|') for x in cells) + ' |')
    return '\n'.join(lines) + '\n'
