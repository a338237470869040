"""
Matching of a planner's verdicts to the requests in a recording.

Requests with a name are matched by it. Others are matched to the nearest verdict with new content:
of requests shortly before it was planned, or shortly after, since a recorder may receive a
planner's answer before the request itself.
"""

from bisect import bisect_left
from collections.abc import Collection, Container, Iterable, Iterator, Sequence
from typing import Protocol

from hmsa.model.status import Code
from hmsa.runs.record import RecordedVerdict

# In ns: maximum delay of recording relative to a message sent later.
_LATE = 50_000_000
# In ns: maximum duration of planning.
_PLANNED = 2_000_000_000
# Codes of verdicts that leave the plan unchanged, besides errors.
_IDLE = {Code.UNCHANGED.value, Code.SUPERSEDED.value}


class RecordedRequest(Protocol):
    """A request: the time of recording, in ns, and its name, if any."""

    @property
    def sent(self) -> int:
        """Time of recording in ns."""

    @property
    def name(self) -> str:
        """Name, empty if there is none."""


def beginning(verdicts: Iterable[RecordedVerdict], number: int = 0) -> Iterator[RecordedVerdict]:
    """Yield the first verdict on each new plan; after a restart, a planner counts from 0."""
    for verdict in verdicts:
        if verdict.plan not in (0, number):
            yield verdict
        number = verdict.plan


def plans_of(verdicts: Sequence[RecordedVerdict], plans: Sequence[int]) -> dict[int, int]:
    """
    Return the plans that were published right before a verdict, if only recording times are known.

    The result maps the recording time of each such plan to that of its verdict, in ns. Both
    arguments are ordered by time; plans are given by their recording times. The first verdict may
    belong to a plan from before the recording.
    """
    found: dict[int, int] = {}
    for verdict in beginning(verdicts, verdicts[0].plan if verdicts else 0):
        near = _nearest(plans, verdict.sent, _LATE, _LATE, found)
        if near is not None:
            found[near] = verdict.sent
    return found


def answered(
        requests: Sequence[RecordedRequest], verdicts: Sequence[RecordedVerdict],
        ) -> tuple[list[tuple[RecordedVerdict | None, bool]], list[RecordedVerdict]]:
    """
    Return the answer of each request and whether it was accepted, and verdicts on other new plans.

    Requests and verdicts are ordered by time. A request without an answer was accepted if no
    verdict came after it, or if plans have no numbers.
    """
    begun = list(beginning(verdicts))
    new = {x.sent: x for x in begun}
    named: dict[str, RecordedVerdict] = {}
    for verdict in verdicts:
        if verdict.request and (verdict.request not in named or (
                verdict.sent in new and named[verdict.request].sent not in new)):
            named[verdict.request] = verdict
    unnamed = {x.sent: x for x in _answers(verdicts, new) if not x.request or not begun}
    times = list(unnamed)
    claimed: set[int] = set()
    found: list[tuple[RecordedVerdict | None, bool]] = []
    for request in requests:
        answer = named.get(request.name)
        if answer is None and not (request.name and begun):
            near = _nearest(times, request.sent, _LATE if begun else 0, _PLANNED, claimed)
            answer = None if near is None else unnamed[near]
        if answer is None:
            found.append((None, not begun or verdicts[-1].sent < request.sent))
        elif begun or answer is named.get(request.name):
            claimed.add(answer.sent)
            found.append((answer, answer.sent in new if begun else answer.level != 'error'))
        else:
            # Without plan numbers, repeats of an earlier verdict look like an answer.
            found.append((None, answer.level != 'error'))
    return found, [x for x in begun if x.sent not in claimed and x is not verdicts[0]]


def _answers(verdicts: Sequence[RecordedVerdict], new: Collection[int]) -> Iterator[
        RecordedVerdict]:
    """Yield the verdicts that may answer a request; ``new`` are times of those on new plans."""
    before: RecordedVerdict | None = None
    for verdict in verdicts:
        fresh = before is None or (verdict.code, verdict.message) != (before.code, before.message)
        if verdict.sent in new or fresh and (
                verdict.level == 'error' or verdict.code in _IDLE or not new):
            yield verdict
        before = verdict


def _nearest(
        times: Sequence[int], time: int, before: int, after: int, without: Container[int],
        ) -> int | None:
    """Return the time nearest to another in a range, except ``without``; None if there is none."""
    begin, end = bisect_left(times, time - before), bisect_left(times, time + after)
    return min((x for x in times[begin:end] if x not in without),
               key=lambda x: abs(x - time), default=None)
