"""A fault, with the expected and the actual response, and its injection."""

from collections.abc import Callable
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


def inject(fault: Fault, domain: int) -> Seen:
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
    return seen
