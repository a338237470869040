"""The paper's figures: data against independent values, figures, and the command."""

from contextlib import redirect_stderr, redirect_stdout
import csv
from functools import cache
from io import StringIO
from pathlib import Path
import re
from typing import Any

from core_oracle import holding_load
from matplotlib import rcParams
from matplotlib.image import imread
import numpy as np
import pytest

from benchmarks import claims
from hmsa.cli import main
from hmsa.model.parameters import NondimensionalParameters
from hmsa.planning.two_step import plan_two_step
from hmsa.report.looks import SCREEN
from hmsa_studies import paper_data
from hmsa_studies.paper import FIGURES, write_figure

ROOT = Path(__file__).resolve().parent.parent
# Coarse, so that drawing takes little time.
POINTS = 121
# Known plans for J_lim 5, zeta 0.2, c1 2, to the digits given.
KNOWN = {
    (1.0, 1.1): (0.160094186, 1.315749737),
    (1.2, 1.4): (0.778278436, 1.351529739),
    (1.0, 0.9): (-0.181403371, 1.249245722),
    (0.8, 0.6): (-1.561198710, 0.984766589),
}
DIGITS = 1e-9
AT_REST = 1e-9


@cache
def computed(number: int) -> Any:
    """Return the data of a figure."""
    return FIGURES[number].compute(POINTS)


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def check_picture(path: Path) -> None:
    image = imread(path)
    assert image.shape[0] > 500
    assert image.shape[1] == 1440
    # Something is drawn, in more than one colour, on white.
    sample = image[::3, ::3, :3]
    assert 0.5 < np.mean(sample.min(axis=2) == 1.0) < 0.99
    assert len({tuple(x) for x in sample.reshape(-1, 3).tolist()}) > 20


@pytest.fixture(scope='module')
def printed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """Return the command's output folder, drawn coarsely, and its output."""
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.chdir(tmp_path_factory.mktemp('work'))
        patch.setattr(paper_data, 'SAMPLES', POINTS)
        patch.setattr(paper_data, 'SWEEP_POINTS', POINTS)
        assert main(['figures', '--dpi', '200']) == 0
        return Path('figures').absolute(), out.getvalue(), err.getvalue()


@pytest.fixture
def folder(printed: tuple[Path, str, str]) -> Path:
    """All figures."""
    return printed[0]


@pytest.mark.parametrize(('name', 'first', 'move'), [
    ('expansion', 0, (1.0, 1.1)), ('expansion', 4, (1.2, 1.4)), ('contraction', 0, (1.0, 0.9))])
def test_the_runs_carry_the_known_plans(
        name: str, first: int, move: tuple[float, float]) -> None:
    run = getattr(paper_data, name)(POINTS)[0]
    assert run.command == 'shaped'
    beta_p, tau_p = KNOWN[move]
    assert run.loads[first] == pytest.approx(beta_p, abs=DIGITS)
    assert run.switches[first + 1] - run.switches[first] == pytest.approx(tau_p, abs=DIGITS)
    assert run.loads[first + 1] == pytest.approx(holding_load(move[1], 5.0), rel=1e-12)


def test_the_deep_contraction_carries_the_known_plan() -> None:
    run, _ = paper_data.respond(
        '', paper_data.DEEP_CONTRACTION, NondimensionalParameters(), samples=POINTS)
    beta_p, tau_p = KNOWN[0.8, 0.6]
    assert run.loads[4] == pytest.approx(beta_p, abs=DIGITS)
    assert run.switches[5] - 20.0 == pytest.approx(tau_p, abs=DIGITS)


@pytest.mark.parametrize('number', [4, 5, 6, 7, 9])
def test_shaped_runs_rest_at_each_target_from_its_arrival_on(number: int) -> None:
    for run in computed(number):
        if run.command != 'shaped':
            continue
        for i, target in enumerate(run.targets):
            held = (run.time >= run.switches[2 * i + 1]) & (run.time <= 10.0 * (i + 1))
            assert np.count_nonzero(held) > 10
            assert np.max(np.abs(run.stretch[held] - target)) < AT_REST


@pytest.mark.parametrize('number', [4, 5, 6, 7, 9])
def test_unshaped_runs_overshoot_each_target(number: int) -> None:
    for run in computed(number):
        if run.command != 'unshaped':
            continue
        for i, (start, target) in enumerate(zip((1.0, *run.targets), run.targets, strict=False)):
            spell = (run.time > 10.0 * i) & (run.time <= 10.0 * (i + 1))
            beyond = (run.stretch[spell] - target) / (target - start)
            assert np.max(beyond) > 0.02


def test_contraction_needs_a_negative_field_throughout(folder: Path) -> None:
    rows = read(folder / 'figure_06.csv')
    assert {row['command'] for row in rows} == {'shaped', 'unshaped'}
    assert max(float(row['b [1]']) for row in rows) < 0.0
    assert max(float(row['beta [mu0 G/Br]']) for row in rows) < 0.0


def test_tables_name_their_columns_with_units_and_hold_every_sample(folder: Path) -> None:
    runs = computed(4)
    rows = read(folder / 'figure_04.csv')
    assert list(rows[0]) == [
        'run', 'command', 'zeta [1]', 'J_lim [1]', 'tau [L sqrt(rho/G)]', 'b [1]',
        'beta [mu0 G/Br]', 'stretch [1]', 'stretch_rate [sqrt(G/rho)/L]']
    assert len(rows) == sum(run.time.size for run in runs)
    for run in runs:
        part = [row for row in rows if row['command'] == run.command]
        # Every bit survives.
        assert [float(row['tau [L sqrt(rho/G)]']) for row in part] == run.time.tolist()
        assert [float(row['stretch [1]']) for row in part] == run.stretch.tolist()
        assert [float(row['stretch_rate [sqrt(G/rho)/L]']) for row in part] == run.rate.tolist()
        for row in part:
            b = float(row['b [1]'])
            assert b * abs(b) == pytest.approx(float(row['beta [mu0 G/Br]']), rel=1e-14)


def test_tables_hold_the_level_from_each_sample_on(folder: Path) -> None:
    plan = plan_two_step(1.0, 1.1, NondimensionalParameters())
    rows = [x for x in read(folder / 'figure_03.csv') if x['command'] == 'shaped']
    for row in rows:
        early = float(row['tau [L sqrt(rho/G)]']) < plan.tau_p
        assert float(row['beta [mu0 G/Br]']) == (plan.beta_p if early else plan.beta_1)
    # The switch is a row of its own.
    assert plan.tau_p in [float(x['tau [L sqrt(rho/G)]']) for x in rows]


def test_b_p_alone_turns_back_at_the_target_and_settles_short_of_it() -> None:
    run = paper_data.single_move(1201)[2]
    assert run.command == 'b_p alone'
    assert np.max(run.stretch) == pytest.approx(1.1, abs=1e-6)
    assert np.all(run.stretch[run.time > 2.5] < 1.09)


def test_tau_p_rises_with_zeta_up_to_the_end_of_the_plans(folder: Path) -> None:
    rows = read(folder / 'figure_08.csv')
    assert len(rows) == POINTS
    assert {row['status'] for row in rows} == {'two_step'}
    zeta = np.array([float(row['zeta [1]']) for row in rows])
    tau_p = np.array([float(row['tau_p [L sqrt(rho/G)]']) for row in rows])
    assert np.all(np.diff(zeta) > 0.0)
    assert np.all(np.diff(tau_p) > 0.0)
    critical = computed(8).critical
    assert critical == pytest.approx(2.1615, abs=5e-5)
    assert 2.14 < zeta[-1] < critical
    assert np.interp(2.0, zeta, tau_p) == pytest.approx(3.19, abs=0.02)


def test_tau_p_rises_and_b_p_falls_with_the_chain_limit(folder: Path) -> None:
    rows = read(folder / 'figure_10.csv')
    j_lim, tau_p, b_p = (
        np.array([float(row[name]) for row in rows])
        for name in ('J_lim [1]', 'tau_p [L sqrt(rho/G)]', 'b_p [1]'))
    assert np.all(np.diff(j_lim) > 0.0)
    assert np.all(np.diff(tau_p) > 0.0)
    assert np.all(np.diff(b_p) < 0.0)
    for value in (1.0, 3.0, 5.0):
        row = rows[int(np.flatnonzero(j_lim == value)[0])]
        plan = plan_two_step(1.0, 1.2, NondimensionalParameters(0.2, value))
        assert float(row['beta_p [mu0 G/Br]']) == pytest.approx(plan.beta_p, rel=1e-12)
        assert float(row['tau_p [L sqrt(rho/G)]']) == pytest.approx(plan.tau_p, rel=1e-12)


def test_the_last_targets_of_figure_9_lie_near_the_paper_s_limits() -> None:
    for run, limit in zip(
            computed(9)[::2], (1.675, 2.262, 2.694), strict=True):
        # 2/l + l^2 - 3 = J_lim
        roots = np.roots([1.0, 0.0, -3.0 - run.material.j_lim, 2.0]).real
        assert max(roots) == pytest.approx(limit, abs=5e-4)
        assert run.targets[2] == pytest.approx(paper_data.NEAR_LIMIT * max(roots), rel=1e-12)


def test_damping_changes_the_shaped_response_less_than_the_plain_one() -> None:
    runs = paper_data.damping_cases(POINTS)
    grid = np.linspace(0.0, 30.0, 601)
    for mode in (runs[:6], runs[6:]):
        spread = {
            command: np.max(np.ptp([
                np.interp(grid, x.time, x.stretch) for x in mode if x.command == command],
                axis=0))
            for command in ('shaped', 'unshaped')}
        assert spread['shaped'] < 0.2 * spread['unshaped']


@pytest.mark.parametrize('number', sorted(FIGURES))
def test_each_figure_is_a_picture_and_a_table(number: int, folder: Path) -> None:
    check_picture(folder / f'figure_{number:02d}.png')
    assert len(read(folder / f'figure_{number:02d}.csv')) >= POINTS


def test_the_same_data_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    rcParams['lines.linewidth'] = 7.0
    try:
        again = write_figure(FIGURES[5], tmp_path, points=POINTS, paper=SCREEN)
        assert rcParams['lines.linewidth'] == 7.0
    finally:
        rcParams['lines.linewidth'] = 1.5
    for path in again:
        assert path.read_bytes() == (folder / path.name).read_bytes()


def test_the_command_writes_all_figures_and_says_so(printed: tuple[Path, str, str]) -> None:
    folder, out, err = printed
    names = [f'figure_{number:02d}.{kind}' for number in range(2, 11) for kind in ('png', 'csv')]
    assert out.splitlines() == [str(Path('figures') / name) for name in names]
    assert sorted(x.name for x in folder.iterdir()) == sorted(names)
    # No progress bar where nobody watches, but a line for what takes long.
    assert all(re.fullmatch(r'Figure \d+(, \d+ s)? \.\.\.', x) for x in err.splitlines())


def test_a_folder_that_cannot_be_made_is_refused_in_one_line(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'taken').write_text('a file')
    assert main(['figures', '--out', str(tmp_path / 'taken')]) == 2
    output = capsys.readouterr()
    assert output.out == ''
    assert output.err.count('\n') == 1
    assert 'taken' in output.err


@pytest.mark.parametrize('name', ['figure_02.csv', 'figure_02.png'])
def test_a_file_that_cannot_be_written_is_refused_in_one_line(
        name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / name).mkdir()
    assert main(['figures', '--out', str(tmp_path)]) == 2
    # Figures that take long on a busy machine are named.
    error, = (x for x in capsys.readouterr().err.splitlines() if not x.endswith(' ...'))
    assert name in error


def test_the_comparison_with_the_paper_says_what_the_computation_says() -> None:
    page = (ROOT / 'docs' / 'validation' / 'paper-comparison.md').read_text(
        encoding='utf-8').splitlines()
    computed = list(claims.lines())
    assert len(computed) > 50
    assert [line for line in computed if line not in page] == []
    # And nothing that is not computed stands among the numbers.
    inside = False
    quoted = []
    for line in page:
        if line.startswith('```'):
            inside = line == '```text'
        elif inside:
            quoted.append(line)
    assert [line for line in quoted if line not in computed] == []
