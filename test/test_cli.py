"""The command line: plan, send, and how bad input is answered."""

import json
import re

import pytest

from hmsa_ros.cli import main

TOLERANCE = 1e-9


def test_plan_prints_the_known_plans_in_full_precision(capsys):
    assert main(['plan', '1.10:10', '1.20:10', '1.40:10', '--json']) == 0
    segments = json.loads(capsys.readouterr().out)['segments']
    assert segments[0]['beta_p'] == pytest.approx(0.160094186, abs=1e-9)
    assert segments[0]['tau_p'] == pytest.approx(1.315749737, abs=1e-9)
    assert segments[0]['beta_1'] == pytest.approx(0.275104307, abs=1e-9)
    assert segments[2]['beta_p'] == pytest.approx(0.778278436, abs=1e-9)
    assert segments[2]['tau_p'] == pytest.approx(1.351529739, abs=1e-9)
    for segment in segments:
        assert segment['status'] == 'two_step'
        assert segment['b_p'] ** 2 == pytest.approx(segment['beta_p'], rel=TOLERANCE)


def test_contraction_has_a_negative_field(capsys):
    assert main(['plan', '0.9:10', '--json']) == 0
    segment = json.loads(capsys.readouterr().out)['segments'][0]
    assert segment['beta_p'] == pytest.approx(-0.181403371, abs=1e-9)
    assert segment['b_p'] == pytest.approx(-(0.181403371 ** 0.5), abs=1e-8)


def test_too_much_damping_falls_back_to_the_plain_step_and_says_so(capsys):
    assert main(['plan', '1.1:10', '--zeta', '3', '--json']) == 0
    segment = json.loads(capsys.readouterr().out)['segments'][0]
    assert segment['status'] == 'too_damped'
    assert segment['beta_p'] is None
    assert main(['plan', '1.1:10', '--zeta', '3']) == 0
    assert 'too damped' in capsys.readouterr().out


@pytest.mark.parametrize(('words', 'said'), [
    (['plan', '0:10'], 'greater than 0'),
    (['plan', '3:10'], 'between the limits 0.2520 and 2.6940'),
    (['plan', '0.2:10'], 'between the limits'),
    (['plan', 'abc'], 'expected STRETCH:SPAN'),
    (['plan', '1.1'], 'expected STRETCH:SPAN'),
    (['plan', '1.1:-1'], 'span is -1'),
    (['plan', '1.1:inf'], 'span is inf'),
    (['plan', 'nan:1'], 'stretch is nan'),
    (['plan'], 'required: STRETCH:SPAN'),
    (['plan', '1.1:1'], 'takes 1.316'),
    (['plan', '1.1:10', '--zeta', '-1'], 'zeta is -1'),
    (['plan', '1.1:10', '--zeta', 'nan'], 'zeta is nan'),
    (['plan', '1.1:10', '--j-lim', '0'], 'j_lim is 0'),
    (['plan', '1.1:10', '--c1', '0'], 'c1 is 0'),
    (['plan', '1.1:10', '--start', '9'], 'start stretch is 9'),
    (['plan', '1.1:10', '--shaper', 'nothing'], 'expected one of two_step'),
    (['plan', '1.1:10', '--nonsense'], 'unrecognized arguments: --nonsense'),
    (['send', 'x'], 'expected STRETCH:SPAN'),
    (['send', '1.1:1', '--timeout', '0'], 'timeout is 0'),
    (['nonsense'], 'invalid choice'),
    ([], 'required'),
])
def test_bad_input_is_answered_in_one_line_with_status_2(words, said, capsys):
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ''
    assert re.fullmatch(r'hmsa: error: [^\n]+\n', captured.err)
    assert said in captured.err


@pytest.mark.ros
def test_send_reports_until_the_sequence_has_been_carried_out(start):
    start.hmsa('planner')
    send = start.hmsa('send', '1.1:0.05', '1.2:0.05', '--wait')
    assert send.wait(30.0) == 0, send.output
    assert 'accepted' in send.stdout
    assert 'done: at_rest' in send.stdout
    assert 'setpoint 2 of 2' in send.stderr


@pytest.mark.ros
def test_send_passes_on_why_the_planner_refuses(start):
    start.hmsa('planner')
    send = start.hmsa('send', '9:1')
    assert send.wait(30.0) == 2
    assert 'the planner refused: target stretch is 9' in send.stderr
    assert len(send.stderr.strip().splitlines()) == 1


@pytest.mark.ros
def test_send_without_a_planner_says_how_to_start_one(start):
    send = start.hmsa('send', '1.1:1', '--timeout', '0.5')
    assert send.wait(30.0) == 1
    assert 'no planner in namespace /; start one with hmsa planner' in send.stderr
