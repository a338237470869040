"""Columns of CSV files: which one is taken for what, and what spreadsheets write."""

import json
import math
import warnings

from hypothesis import given
from hypothesis import strategies as st
import pytest

import hmsa
from hmsa.api.paths import read_path
from hmsa.cli import main
from hmsa.columns import read_currents, read_table
from hmsa.errors import AssumedWarning, BadInputError
from hmsa.identification.measurement import read_levels
from hmsa.model.laws.curve import points_in
from hmsa_lab.bench.assembly import CoilModel

WANTED = ('time', 'flux_density')


@pytest.fixture
def csv(tmp_path):
    """Return a function that writes a CSV."""
    def write(text, encoding='utf-8'):
        path = tmp_path / 'it.csv'
        path.write_text(text, encoding=encoding)
        return path

    return write


@pytest.mark.parametrize('other', ['field', 'B', 'flux', 'effort', 'b [mT]', 'flux density [mT]'])
def test_a_column_of_the_exact_name_wins_wherever_it_stands(csv, other):
    for header, row in ((f'time,{other},flux_density', '0,9,0.1'),
                        (f'time,flux_density,{other}', '0,0.1,9')):
        table = read_table(csv(f'{header}\n{row}\n'), WANTED)
        assert table.columns['flux_density'].tolist() == [0.1]


@pytest.mark.parametrize('other', ['t', 'stamp', 'Timestamp', 'time_ns', 'time [ms]'])
def test_the_exact_time_wins_over_stamps_and_units(csv, other):
    table = read_table(csv(f'{other},time,flux_density\n7,2,0.1\n'), WANTED)
    assert table.columns['time'].tolist() == [2.0]


@pytest.mark.parametrize(('header', 'names'), [
    ('time,field,b', "'field' and 'b'"), ('t,stamp,flux_density', "'t' and 'stamp'"),
    ('time [ms],time_ns,flux_density', r"'time \[ms\]' and 'time_ns'"),
    ('time,Flux_density,flux density', "'Flux_density' and 'flux density'")])
def test_two_candidates_without_an_exact_one_are_refused_by_name(csv, header, names):
    with pytest.raises(BadInputError, match=f'columns {names}, each of which may be .*: expected'):
        read_table(csv(f'{header}\n0,1,2\n'), WANTED)


def said(read):
    """Return the assumptions of a call, which are said at its line."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter('always')
        read()
    assert {(x.category, x.filename) for x in seen} == {(AssumedWarning, __file__)}
    return [str(x.message).partition(': ')[2] for x in seen]


def test_each_reader_says_what_it_took_for_what(csv):
    path = csv('t,position,field\n0,1,0\n1,1.1,0.1\n')
    time, field = "column 't' was taken for time", "column 'field' was taken for flux_density"
    for read in (read_levels, hmsa.Actuator().simulate):
        assert said(lambda read=read: read(path)) == [time, field]
    assert said(lambda: read_path(path)) == [time, "column 'position' was taken for stretch"]
    path = csv('lambda,b\n' + '\n'.join(f'{1 + 0.05 * i:g},{0.02 * i:g}' for i in range(-3, 4)))
    assert said(lambda: points_in(str(path))) == [
        "column 'lambda' was taken for stretch", "column 'b' was taken for flux_density"]
    path = csv('current [mA],field\n-1000,-0.1\n0,0\n1000,0.1\n')
    assert said(lambda: CoilModel(file=str(path))) == [field]


def test_a_command_says_it_once_and_in_its_json(csv, capsys, tmp_path):
    path = csv('time,field\n0,0.01\n0.1,0.0\n')
    (tmp_path / 'block.yaml').write_text(
        '/**: {ros__parameters: {actuator.remanence: 0.1}}\n', encoding='utf-8')
    words = ['simulate', str(path), '--params-file', str(tmp_path / 'block.yaml')]
    assert main(words) == 0
    note = f"{path}: column 'field' was taken for flux_density"
    assert capsys.readouterr().err == f'hmsa: note: {note}\n'
    assert main([*words, '--json']) == 0
    out, err = capsys.readouterr()
    assert err.count('note') == 1
    assert json.loads(out)['notes'] == [note]


@pytest.mark.parametrize('text', [
    'sep=;\ntime;flux_density\n0,5;-0,1\n', '"sep=,"\ntime,flux_density\n0.5,-0.1\n',
    'time,flux_density\ns,T\n0.5,-0.1\n', 'time;flux_density\n[ms];(mT)\n500;-100\n',
    'time [s],flux_density\n,mT\n0.5,-100\n', 'time,flux_density\n0.5,\u22120.1\n',
    'time\tflux_density\n0,5\t\u22120,1\n', 'sep=|\ntime|flux_density\n# by hand\n0.5|-0.1\n'])
def test_what_spreadsheets_write_is_read(csv, text):
    table = read_table(csv(text), WANTED, notes=[])
    assert table.columns['time'].tolist() == [0.5]
    assert table.columns['flux_density'].tolist() == pytest.approx([-0.1], rel=1e-15)
    assert table.lines.tolist() == [len(text.splitlines())]


@pytest.mark.parametrize('cell', ['#N/A', '-', '--', '', 'n/a', '#DIV/0!', '#VALUE!', '\u2013'])
def test_a_missing_value_is_missing_in_any_column(csv, cell):
    table = read_table(csv(f'time,flux_density\n{cell},0.1\n1,{cell}\n'), WANTED)
    assert math.isnan(table.columns['time'][0])
    assert math.isnan(table.columns['flux_density'][1])


CELLS = st.sampled_from((
    'time', 't', 'field', 'b', 'flux_density', 'flux density [mT]', 'stretch', 'length [mm]', 's',
    'mT', '-', '#N/A', '', '0', '1', '2.5', '-0,5', '\u22121', 'inf', '1e999', '"', '\0',
    '\u03bbx'))


@given(st.lists(st.lists(CELLS, max_size=4), max_size=5), st.sampled_from(',;\t|'),
       st.sampled_from(('', 'sep=;\n', 'sep=')), st.sampled_from(('utf-8', 'utf-16', 'cp1253')))
def test_any_file_is_columns_of_numbers_or_one_sentence(tmp_path_factory, rows, by, first, code):
    path = tmp_path_factory.getbasetemp() / 'any.csv'
    path.write_bytes((first + '\n'.join(map(by.join, rows))).encode(code, 'replace'))
    for wanted, length in ((WANTED, None), (('time', 'stretch'), 0.02)):
        try:
            table = read_table(path, wanted, rest_length=length, notes=[])
        except BadInputError:
            continue
        assert {len(x) for x in table.columns.values()} == {len(table.lines)}


@pytest.mark.parametrize(('text', 'message'), [
    ('time,flux_density\ns,furlongs\n0,1\n', 'in furlongs: expected T, tesla, mT, G, gauss'),
    ('time [ms],flux_density\ns,T\n0,1\n', "line 2 gives time in 's', its header in 'ms'"),
    ('time,stretch [mm]\n0,20\n', 'stretch in mm: .*at rest, .*hmsa identify --rest-length 20mm'),
    ('time,length [mm]\n0,20\n', 'no column stretch.*hmsa identify --rest-length 20mm'),
    ('time,position\ns,mm\n0,20\n', 'gives stretch in mm: expected no unit: divide it by'),
    ('time,stretch [%]\n0,20\n', 'divide percent by 100'),
    ('time,strain [%]\n0,20\n', 'stretch is strain in percent over 100 plus 1'),
    ('time,displacement [mm]\n0,2\n', 'is the change of length over the length at rest, plus 1'),
    ('time [ms] flux_density\n0 1\n', 'spaces between its columns .*: expected commas'),
    ('sep=;\n', 'is empty')])
def test_another_unit_is_refused_with_what_to_do(csv, text, message):
    wanted = WANTED if 'flux' in text else ('time', 'stretch')
    with pytest.raises(BadInputError, match=message):
        read_table(csv(text), wanted)


def test_lengths_under_another_name_are_refused_with_the_name_that_counts(csv):
    with pytest.raises(
            BadInputError, match=r'no column stretch.*call the column of lengths length \[mm\]$'):
        read_table(csv('time,height [mm]\n0,20\n'), ('time', 'stretch'), rest_length=0.02)


def test_only_who_wants_currents_of_a_coil_judges_them(csv):
    path = csv('current,flux_density\n-2000,-0.1\n0,0\n2000,0.1\n')
    assert read_table(path, ('current', 'flux_density')).columns['current'][-1] == 2000.0
    with pytest.raises(BadInputError, match='has currents up to 2000 without a unit: expected'):
        read_currents(path)


def test_a_path_that_stands_still_in_time_is_refused_with_its_line(csv):
    with pytest.raises(BadInputError, match='line 4 has the time 0.1 s after 0.1 s: expected'):
        read_path(csv('time,stretch\n0,1\n0.1,1.1\n0.1,1.0\n'))
