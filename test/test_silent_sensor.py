"""A sensor that is silent for a while neither moves nor delays the start of a request."""

from dataclasses import replace
import random

import pytest
from test_runtime_hosts import BEATING, Bench
from test_runtime_planner import MS, START, trajectory

from hmsa_ros.runtime.records import Severity, StretchRequest


class Watched(Bench):
    """A bench whose samples the planner reads, too."""

    def advance(self):
        super().advance()
        if self.samples:
            self.observe()


SETTINGS = replace(BEATING, takeover_timeout=500 * MS)


@pytest.mark.parametrize(('silence', 'feedback'), [
    (300, 'off'), (1000, 'adapt'), (1900, 'off'), *(
        pytest.param(*x, marks=pytest.mark.slow) for x in (
            (700, 'off'), (1000, 'off'), (1500, 'off'), (300, 'adapt'), (700, 'adapt'),
            (1500, 'adapt'), (1900, 'adapt')))])
def test_requests_while_a_sensor_is_silent_start_as_predicted(silence, feedback):
    chance, rig = random.Random(silence), Watched(settings=replace(SETTINGS, feedback=feedback))
    rig.go(StretchRequest('a', 1.2), START + 1000 * MS)
    rig.go(StretchRequest('a', 1.4), rig.now + chance.randrange(20, 400) * MS)
    rig.samples, end = False, rig.now + silence * MS
    while rig.now < end:
        stretch = chance.choice([1.05, 1.1, 1.25, 1.3, 1.4])
        rig.go(StretchRequest('a', stretch), min(rig.now + chance.randrange(100, 500) * MS, end))
    rig.samples = True
    rig.go(StretchRequest('a', 1.15), rig.now + 500 * MS)
    assert rig.status.verdict.severity is Severity.OK
    assert not rig.noted('planning continues from the sample')
    assert rig.residual(1.15) < 1e-6


def test_a_sample_from_before_the_last_change_of_level_does_not_move_a_start():
    rig = Bench(settings=SETTINGS)
    rig.go(trajectory((1.2, 700 * MS), (1.1, 10_000 * MS)), START + 400 * MS)
    # The sensor shows another stretch for the last time before the level changes.
    rig.lost = True
    rig.run(START + 650 * MS)
    rig.samples = False
    rig.run(START + 1500 * MS)
    sent = len(rig.sent)
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'waiting'
    rig.run(rig.now + 600 * MS)
    assert rig.status.verdict.code == 'unseen'
    assert {x.flux_density for _, x in rig.sent[sent:]} == {rig.sent[sent - 1][1].flux_density}
    assert rig.residual(1.1) < 1e-6
    rig.samples, rig.lost = True, False
    rig.arrive(1.3, rig.now + 600 * MS)
