"""Faults of recordings, without nodes: all damage must be reported."""

from benchmarks.faults.common import Register
from benchmarks.faults.rig import Rig
from benchmarks.faults.table import Seen
from benchmarks.flips import samples

FAULTS = Register()
_FLIPS = 2000


@FAULTS.fault(
    'bag_flips', 'one bit of a bag changed',
    f'{_FLIPS} bits of record headers; closed, killed, plain and compressed bags',
    'reported, or without effect')
def _flips(rig: Rig) -> Seen:
    results = [result for _, result in samples(_FLIPS, rig.folder)]
    wrong = [place for result in results for place in result.wrong]
    return Seen(
        f'{sum(x.said for x in results)} reported, '
        f'{sum(x.harmless for x in results)} without effect',
        f'{len(wrong)} unreported', not wrong)
