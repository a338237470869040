"""The hysteresis of an iron core: fitted to a staircase, and compensated."""

import numpy as np
import pytest

from benchmarks.laboratory import Iron
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.runs.parameters import entries_of
from hmsa_lab.bench.assembly import Assembly, CoilModel, fit_core, IronCore, parts
from hmsa_lab.bench.calibration import loop

LARGEST, SLOPE = 0.14, 0.05
MS = 1_000_000


class Source:
    """A source that stores levels, with a coil whose core is unknown to it."""

    resolution = 1e-6

    def __init__(self, core):
        self.core, self.amperes, self.ahead, self.told = core, 0.0, [], []

    def write(self, current, now):
        self.ahead = []
        self.amperes = current
        return now, current

    def schedule(self, levels):
        if levels:
            self.ahead = [x for x in self.ahead if x[0] < levels[0][0]] + list(levels)

    def go_on(self, now):
        """Output the levels that are due; return the field."""
        while self.ahead and self.ahead[0][0] <= now:
            stamp, self.amperes = self.ahead.pop(0)
            self.told.append((stamp - 400, self.amperes))  # it counts in us
            field = self.core.field(SLOPE * self.amperes)
            self.core.turn(SLOPE * self.amperes)
        return field

    def applied(self):
        told, self.told = self.told, []
        return told


def plays(level, widths, weights):
    """Return the field of plays for successive levels, from a demagnetised core."""
    states, found = [0.0] * len(widths), []
    for x in level:
        states = [min(max(y, x - r), x + r) for y, r in zip(states, widths, strict=True)]
        found.append(sum(w * y for w, y in zip(weights, states, strict=True)))
    return found


@pytest.fixture(scope='module')
def settings(tmp_path_factory):
    """Return the output of hmsa calibrate coil for a coil with 2 % of hysteresis."""
    folder, core = tmp_path_factory.mktemp('core'), Iron(0.02 * LARGEST, 0.3 * LARGEST)
    rows, noise = ['current,flux_density'], np.random.default_rng(1)
    for level in loop(LARGEST, 8):
        rows.append(f'{level / SLOPE},{core.field(level) + 2e-3 + noise.normal(0.0, 2e-5)}')
        core.turn(level)
    (folder / 'readings.csv').write_text('\n'.join(rows))
    assert main(['calibrate', 'coil', str(folder / 'readings.csv'), '--hysteresis', '--out',
                 str(folder / 'coil.yaml')]) == 0
    return {x.removeprefix('hardware.'): y for _, x, y in entries_of(folder / 'coil.yaml')}


def fields(coil, levels):
    """Return fields if levels are scheduled two ahead, and the second is replaced."""
    source = Source(Iron(0.02 * LARGEST, 0.3 * LARGEST))
    assembly, found = Assembly(source, coil), []
    for i, level in enumerate(levels):
        assembly.schedule([(i * MS, level), (i * MS + MS // 2, 0.11)])
        assembly.schedule([(i * MS + MS // 2, level)])
        found.append(source.go_on(i * MS))
        *_, (stamp, told) = assembly.applied()
        assert stamp == i * MS - 400
        assert told == pytest.approx(level, abs=1e-6)
    return np.array(found)


def test_a_core_that_is_found_in_a_staircase_is_undone_for_other_levels(settings):
    levels = np.random.default_rng(2).uniform(0.0, LARGEST, 60)
    scale = {x: y for x, y in settings.items() if 'play' not in x}
    with_core, without = (
        fields(parts(x)[0], levels)[10:] - levels[10:] for x in (settings, scale))
    rms = [float(np.sqrt(np.mean(np.square(x)))) for x in (without, with_core)]
    assert rms[0] > 0.01 * LARGEST
    assert rms[1] < rms[0] / 3.0


def test_plays_are_found_and_undone_to_the_last_bit_or_nearly():
    widths, weights = (0.0, 0.0175, 0.07), (0.9, 0.06, 0.04)
    level = np.array(loop(LARGEST, 4))
    core, left = fit_core(level, np.array(plays(level, widths, weights)))
    assert left < 1e-12
    assert list(core.widths) == pytest.approx(widths)
    assert list(core.weights) == pytest.approx(weights)
    wanted = np.random.default_rng(3).uniform(-0.2, 0.2, 200)
    compensation = CoilModel(1.0, play_widths=widths, play_weights=weights).compensation()
    asked = [compensation.ask(i, x) for i, x in enumerate(wanted)]
    assert plays(asked, widths, weights) == pytest.approx(wanted, abs=1e-14)


def test_a_coil_that_is_switched_off_has_no_current(settings):
    source = Source(Iron(0.0, 1.0))
    assembly = Assembly(source, parts(settings)[0])
    assembly.write(0.1, MS)
    assert assembly.write(0.0, 2 * MS) == (2 * MS, 0.0)
    assert source.amperes == 0.0


@pytest.mark.parametrize(('widths', 'weights'), [
    ([0.0], []), ([0.1], [1.0]), ([0.0, 0.0], [1.0, 1.0]), ([0.0, 0.1], [0.0, 1.0]),
    ([0.0, 0.1], [1.0, -1.0]), ([0.0, float('nan')], [1.0, 1.0]), ('abc', [1.0]), (0.0, 1.0)])
def test_plays_that_are_none_are_refused(widths, weights):
    with pytest.raises(BadInputError, match=r'coil.play_widths is .* --hysteresis writes them'):
        IronCore(widths, weights)


@pytest.mark.parametrize('current', [
    [0.0, 1.0, 2.0, 1.0, 0.0], [-2.0, -1.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 0.0]])
def test_no_hysteresis_is_written_where_no_loop_was_read(current, tmp_path, refusal):
    (tmp_path / 'x.csv').write_text('current,flux_density\n' + ''.join(
        f'{x},{0.05 * x}\n' for x in current))
    assert 'expected' in refusal('calibrate coil', tmp_path / 'x.csv', '--hysteresis')
