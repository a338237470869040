"""Assignment of verdicts to requests, from the messages of a recorder and their times."""

from dataclasses import dataclass

import pytest

from hmsa.runs.answers import answered, plans_of
from hmsa.runs.record import RecordedVerdict

MS = 1_000_000


@dataclass(frozen=True)
class Asked:
    sent: int
    name: str = ''


def said(time, plan, code='accepted', level='ok', name=''):
    return RecordedVerdict(round(time * MS), level, code, code, plan, name)


NONE = said(0, 0, 'none')


@pytest.mark.parametrize(('requests', 'verdicts', 'taken', 'others'), [
    # A recorder receives what was sent first last.
    ([11, 101], [NONE, said(10, 1), said(100, 2)], [True, True], []),
    # A stop right before a request, and another at the end.
    ([12, 101], [NONE, said(10, 1), said(80, 2), said(103, 3), said(200, 4)],
     [True, True], [80, 200]),
    # One is refused, and then the joint is to stop.
    ([9, 99], [NONE, said(10, 1), said(100, 1, 'out_of_range', 'error'), said(150, 2)],
     [True, False], [150]),
    # What was found of the first looks like no answer to the second, which was planned for long.
    ([9, 99], [NONE, said(10, 1), said(98, 1, 'arrived'), said(900, 2)], [True, True], []),
    ([9, 99], [NONE, said(10, 1), said(101, 1, 'unchanged')], [True, False], []),
    # A planner that began anew.
    ([9, 99, 2009], [NONE, said(10, 1), said(100, 2), said(1000, 0, 'none'), said(2010, 1)],
     [True] * 3, []),
    # Nobody was there, or nothing was recorded after it.
    ([9, 5000, 9000], [NONE, said(5001, 1)], [False, True, True], []),
    # The first verdict is of a plan of before the recording.
    ([99], [said(0, 7, 'arrived'), said(100, 8)], [True], []),
    # Verdicts without numbers of plans.
    ([9, 99], [said(10, 0), said(100, 0, 'out_of_range', 'error')], [True, False], []),
    ([9], [], [True], []),
])
@pytest.mark.parametrize('named', [False, True])
def test_which_requests_were_taken(requests, verdicts, taken, others, named):
    asked = [Asked(x * MS, str(x) * named) for x in requests]
    if named:
        # Each verdict has the name of the request that came last, by the clock of the planner.
        mine, _ = answered([Asked(x.sent) for x in asked], verdicts)
        names = {x.sent: y.name for (x, _), y in zip(mine, asked, strict=True) if x is not None}
        renamed, name = [], ''
        for x in verdicts:
            name = '' if x.sent in [y * MS for y in others] else names.get(x.sent, name)
            renamed.append(RecordedVerdict(x.sent, x.level, x.code, x.message, x.plan, name))
        verdicts = renamed
    found, unasked = answered(asked, verdicts)
    assert [x for _, x in found] == taken
    assert [x.sent for x in unasked] == [x * MS for x in others]


def test_a_request_of_a_name_is_answered_by_that_alone():
    verdicts = [NONE, said(10, 1, name='a'), said(11, 2, name='b'), said(30, 3, name='c')]
    found, unasked = answered([Asked(12 * MS, 'b'), Asked(13 * MS, 'a')], verdicts)
    assert [(x.sent // MS, taken) for x, taken in found] == [(11, True), (10, True)]
    assert [x.sent // MS for x in unasked] == [30]


def test_plans_belong_to_the_nearest_first_verdict_on_one():
    verdicts = [said(0, 3), said(10, 4), said(12, 4, 'moving'), said(100, 5), said(500, 6)]
    plans = [x * MS for x in (1, 13, 60, 98, 200)]
    # The plan of before the recording, and those that were made anew, belong to none.
    assert plans_of(verdicts, plans) == {13 * MS: 10 * MS, 98 * MS: 100 * MS}
