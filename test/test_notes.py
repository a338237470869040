"""Assumptions of commands: which actuator stands in for one that was not named."""

import json

import pytest

import hmsa
from hmsa.cli import main
from hmsa.errors import AssumedWarning
from hmsa.identification.files import read_belief

NOTE = 'hmsa: note: without --params-file the actuator is the example block: 20 mm x 20 mm x 20 mm'
COMMANDS = {
    'simulate': ['simulate', 'levels.csv'],
    'wave': ['wave', 'sine', '--frequency', '30', '--amplitude', '0.05', '--cycles', '1'],
    'excite': ['excite', '--duration', '0.2']}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Return a folder with levels and parameters, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'levels.csv').write_text('time,flux_density\n0,0.01\n0.1,0\n', encoding='utf-8')
    (tmp_path / 'block.yaml').write_text(
        '/**: {ros__parameters: {actuator.half_length: 0.01}}\n', encoding='utf-8')
    return tmp_path


def quick(err):
    """Return the lines but those of what takes long on a busy machine."""
    return ''.join(x for x in err.splitlines(keepends=True) if not x.endswith(' ...\n'))


@pytest.mark.parametrize('words', COMMANDS.values(), ids=COMMANDS)
def test_a_command_without_a_file_says_once_that_it_takes_the_example(here, capsys, words):
    assert main([*words, '--json']) == 0
    out, err = capsys.readouterr()
    note = quick(err)
    assert note.startswith(NOTE)
    assert note.count('\n') == 1
    assert note.strip().removeprefix('hmsa: note: ') in json.loads(out)['notes']
    assert main([*words, '--params-file', 'block.yaml']) == 0
    assert quick(capsys.readouterr().err) == ''


def test_bad_input_is_one_line_and_a_refusal_names_the_assumption(here, capsys):
    assert main(['simulate', 'levels.csv', '--noise', '-1']) == 2
    assert capsys.readouterr().err == (
        'hmsa: error: noise is -1: expected a finite number of at least 0\n')
    assert main([*COMMANDS['wave'], '--frequency', '3000', '--json']) == 2
    err = capsys.readouterr().err
    assert err.startswith('hmsa: error: an amplitude of 0.05')
    assert err.count('\n') == 1
    assert '; note: without --params-file the actuator is the example block' in err
    assert main([*COMMANDS['wave'], '--cycles', '0']) == 2
    assert capsys.readouterr().err == (
        'hmsa: error: cycles is 0: expected 1 to 1e+06\n')


def test_a_section_for_another_node_is_not_used_and_said(here, capsys):
    (here / 'it.yaml').write_text(
        '/**: {ros__parameters: {actuator.remanence: 0.11}}\n'
        'planr: {ros__parameters: {actuator.remanence: 0.12}}\n'
        'left: {plant: {ros__parameters: {actuator.half_length: 0.02}}}\n', encoding='utf-8')
    for words in (COMMANDS['wave'], ['plan', '1.01:1']):
        assert main([*words, '--params-file', 'it.yaml']) == 0
        assert quick(capsys.readouterr().err) == (
            "hmsa: note: it.yaml: its section '/planr' is not used: expected /**, planner, plant "
            'or driver, the nodes that read parameters of an actuator\n'
            'hmsa: note: it.yaml: its section plant alone sets actuator.half_length: plans use '
            'the parameters of planner or of all nodes (/**), or else the defaults\n')
    with pytest.warns(AssumedWarning, match='/planr'):
        belief = read_belief(here / 'it.yaml')
    assert (belief.actuator.remanence, belief.actuator.half_length) == (0.11, 0.02)


def test_parameters_of_single_joints_are_not_used_for_one_actuator_and_said(here, capsys):
    (here / 'it.yaml').write_text(
        '/**: {ros__parameters: {joints: [left, right], actuator.remanence: 0.11,\n'
        '  left.actuator.remanence: 0.12, right: {flux_density_max: 0.3}, record.topics: [it]}}\n',
        encoding='utf-8')
    for words in (COMMANDS['wave'], ['plan', '1.01:1']):
        assert main([*words, '--params-file', 'it.yaml']) == 0
        assert quick(capsys.readouterr().err) == (
            'hmsa: note: it.yaml: parameters of left, right are not used, only those of all '
            'joints: expected those of one actuator; write a file for each\n')
    with pytest.warns(AssumedWarning, match='parameters of left, right are not used'):
        assert read_belief(here / 'it.yaml').actuator.remanence == 0.11


def test_sections_for_several_namespaces_are_said(here):
    (here / 'it.yaml').write_text(
        '/left/planner: {ros__parameters: {actuator.remanence: 0.11}}\n'
        '/right/planner: {ros__parameters: {actuator.remanence: 0.12}}\n', encoding='utf-8')
    with pytest.warns(AssumedWarning, match='/left/planner and /right/planner are sections for'):
        assert read_belief(here / 'it.yaml').actuator.remanence == 0.12


def test_a_plan_without_dimensions_assumes_nothing(here, capsys):
    assert main(['plan', '1.1:10']) == 0
    assert capsys.readouterr().err == ''


def test_an_identification_says_which_values_are_those_of_the_example(here, capsys):
    assert main(['simulate', 'levels.csv', '--params-file', 'block.yaml', '--until', '0.3',
                 '--noise', '1e-4', '--out', 'samples.csv']) == 0
    words = ['identify', 'samples.csv', '--commands', 'levels.csv', '--json']
    found = []
    for more in ([], ['--known', 'half_length=1cm,half_thickness=1cm,density=1900'],
                 ['--params-file', 'block.yaml'], ['--known', 'half_length=1cm']):
        capsys.readouterr()
        main([*words, *more])
        found.append([x for x in json.loads(capsys.readouterr().out)['warnings']
                      if 'example block' in x])
    assert [len(x) for x in found] == [1, 0, 0, 1]
    assert found[0][0].startswith(
        'half_length, half_thickness, density are not given: 0.01 m, 0.01 m, 1900 kg/m^3 of the '
        'example block')
    assert found[3][0].startswith('half_thickness, density are not given')
    found = hmsa.identify('samples.csv', 'levels.csv')
    assert any('example block' in x for x in found.result.warnings)
    found = hmsa.identify('samples.csv', 'levels.csv', actuator=hmsa.Actuator())
    assert not any('example block' in x for x in found.result.warnings)
