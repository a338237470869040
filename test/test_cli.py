"""The command line: plan, send, and reactions to bad input."""

import argparse
from contextlib import redirect_stdout
import fcntl
from functools import wraps
import json
import os
from pathlib import Path
import pty
import re
import select
import shlex
import shutil
import struct
import subprocess
import sys
import termios
import time

from conftest import without_progress
import pytest

from hmsa.cli import build_parser, main, split_ros_args, terminal
from hmsa.cli.completion import commands_of
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError
from hmsa.files import write_text
from hmsa.planning.shapers import SHAPERS
from hmsa.plugins import COMMANDS, NODES, registered

TOLERANCE = 1e-9
ROOT = Path(__file__).resolve().parent.parent
WAIT_SECONDS = 60.0


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
    ('plan 0:10', 'greater than 0'), ('plan 3:10', 'between the limits 0.2520 and 2.6940'),
    ('plan 0.2:10', 'between the limits'), ('plan abc', 'expected STRETCH:DURATION'),
    ('plan 1.1', 'expected STRETCH:DURATION'), ('plan 1.1:-1', 'duration is -1'),
    ('plan 1.1:inf', 'duration is inf'), ('plan nan:1', 'stretch is nan'),
    ('plan', 'expected STRETCH:DURATION'), ('plan 1.1:1', 'takes 1.316'),
    ('plan 1.1:10 --zeta -1', 'zeta is -1'), ('plan 1.1:10 --zeta nan', 'zeta is nan'),
    ('plan 1.1:10 --j-lim 0', 'j_lim is 0'), ('plan 1.1:10 --c1 0', 'c1 is 0'),
    ('plan 1.1:10 --start 9', 'start stretch is 9'),
    ('plan 1.1:10 --shaper nothing', 'expected one of two_step'),
    ('plan 1.1:10 --nonsense', 'unrecognized arguments: --nonsense'),
    ('plan 1.1,1.2:10', 'expected STRETCH:DURATION'), ('send x', 'expected STRETCH:DURATION'),
    ('send 1.1,:1', 'expected STRETCH:DURATION'), ('send 1.1,nan:1', 'stretch is nan'),
    ('send 1.1:1 --timeout 0', 'timeout is 0'),
    ("send 1.1:1 --namespace '9 bad'", "namespace '9 bad': Invalid namespace"),
    ('plot', "invalid choice: 'plot': did you mean"),
    ('xyzzy', "invalid choice: 'xyzzy': expected one of bag, "),
    ('plann 1.1:10', "invalid choice: 'plann': did you mean plan?; see hmsa --help"),
    ('record', 'did you mean hmsa recorder?'), ('play bag', 'did you mean hmsa player?'),
    ('bag play x', 'did you mean hmsa player?'), ('bag inof x', 'did you mean info?'),
    ('plan 1.1:10 --shapre=step', '--shapre=step; did you mean --shaper?'), ('', 'required')])
def test_bad_input_is_answered_in_one_line_with_status_2(words, said, refusal):
    assert said in refusal(words)


@pytest.mark.parametrize(('words', 'needed'), [
    ('plan 1.1:10 --inductance 5mH', '--amplifier'), ('plan 1.1:10 --resistance 2', '--amplifier'),
    ('plan 1.1:10 --order 3', '--shaper robust or --shaper minimax or --shaper modal'),
    ('plan 1.1:10 --shaper zv --errors 0.1,0.1,0.1', '--shaper minimax'),
    ('plan 1.1:10 --periods 2', '--shaper smooth'),
    ('plan 1.1:10 --max-rate 2', '--shaper smooth'),
    ('identify bag --accept', '--out'),
    ('simulate levels.csv --seed 1', '--noise'), ('watch --timeout 1', '--once'),
    ('report bag --width 85', '--picture'), ('compare a b --data', '--picture'),
    ('sweep --show residual', '--picture or --out'), ('robustness --seeds 2', '--feedback')])
def test_an_option_without_the_one_that_it_needs_is_refused(words, needed, capsys):
    assert main(words.split()) == 2
    option = [x for x in words.split() if x.startswith('--')][-1]
    assert capsys.readouterr().err == f'hmsa: error: {option} needs {needed}\n'


@pytest.mark.parametrize(('command', 'file'), [
    ('simulate in.csv --until 0.3 --out in.csv', 'in.csv'),
    ('simulate in.csv --until 0.3 --picture in.png --data', 'in.csv'),
    ('simulate a_levels.csv --until 0.3 --out a.csv', 'a_levels.csv'),
    ('simulate in.csv --until 0.3 --out out.csv --picture out.png --data', 'out.csv'),
    ('plan --path in.csv --params-file in.yaml --out in.csv', 'in.csv'),
    ('wave in.csv --frequency 3 --amplitude 0.05 --out in.csv', 'in.csv'),
    ('wave sine --frequency 3 --amplitude 0.05 --out out.csv --path out.csv', 'out.csv'),
    ('excite --params-file in.yaml --duration 0.2 --out in.yaml', 'in.yaml'),
    ('calibrate coil in.csv --out in.csv', 'in.csv'),
    ('calibrate coil in.csv --out out.yaml --picture out.png --data', 'out.csv'),
    ('calibrate latency --simulate --params-file in.yaml --out in.yaml', 'in.yaml'),
    ('sweep --cases in.csv --out in.csv', 'in.csv')])
def test_no_command_writes_over_what_it_reads_or_wrote(
        command, file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ('in.csv', 'a_levels.csv', 'in.yaml'):
        Path(name).write_text('zeta\n0.1\n')
    assert main(command.split()) == 2
    assert f'cannot write {file}: ' in capsys.readouterr().err
    assert {x.read_text() for x in tmp_path.iterdir()} == {'zeta\n0.1\n'}


# Nobody creates a file in /proc, not even root.
@pytest.mark.parametrize('command', [
    'excite --params-file in.yaml --out /proc/levels.csv',
    'identify in.csv --commands in.csv --out /proc/found.yaml',
    'tune 1.1:1 --simulate --report /proc/tuned.html', 'learn in.csv --out /proc/levels.csv',
    'plan 1.1:1 --params-file in.yaml --out /proc/levels.csv',
    'calibrate latency --simulate --params-file in.yaml --out /proc/found.yaml'])
def test_a_folder_without_write_permission_is_refused_before_the_work(
        command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith('hmsa: error: cannot write /proc/')
    assert err.endswith('expected a folder with write permission and room\n')
    assert list(tmp_path.iterdir()) == []


def test_a_write_protected_file_is_not_replaced(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path('kept.yaml').write_text('kept')
    Path('kept.yaml').chmod(0o444)
    # Root may write anything.
    monkeypatch.setattr(os, 'access', lambda path, _: bool(Path(path).stat().st_mode & 0o200))
    assert main(['init', '--yes', '--force', '--out', 'kept.yaml']) == 2
    assert 'cannot write kept.yaml: it is write-protected' in capsys.readouterr().err
    with pytest.raises(BadInputError, match='it is write-protected'):
        write_text(Path('kept.yaml'), 'new')
    assert Path('kept.yaml').read_text() == 'kept'
    assert [x.name for x in tmp_path.iterdir()] == ['kept.yaml']


@pytest.mark.slow
@pytest.mark.ros
def test_send_reports_until_the_sequence_has_been_carried_out(start, ros):
    # Commands far enough ahead for a busy machine.
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=2.0')
    # Nobody carries it out yet.
    send = start.hmsa('send', '1.1:0.05', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 1, send.output
    assert 'not carried out: no node subscribes to /flux_density_command' in send.stderr
    start.hmsa('plant')
    ros.spin_until(lambda: ros.node.count_publishers('joint_states'), 'the plant')
    send = start.hmsa('send', '1.0:0.5', '1.1:0.1', '1.2:0.1', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 0, send.output
    assert 'accepted' in send.stdout
    assert 'done: at_rest, measured' in send.stdout
    assert 'setpoint 3 of 3' in send.stderr


@pytest.mark.slow
@pytest.mark.ros
def test_send_is_patient_in_simulated_time_that_is_slower_than_the_wall(start, ros):
    start.hmsa(
        'plant', '--ros-args', '-p', 'publish_clock:=true', '-p', 'real_time_factor:=0.1')
    start.hmsa('planner', '--ros-args', '-p', 'use_sim_time:=true')
    ros.spin_until(lambda: ros.node.count_publishers('flux_density_command'), 'the planner')
    # Ten times that on the wall: more than the sequence and the patience together.
    send = start.hmsa('send', '1.1:0.7', '--wait', '--timeout', '5')
    assert send.wait(60.0) == 0, send.output


@pytest.mark.slow
@pytest.mark.ros
def test_send_trusts_a_driver_that_publishes_samples_alone(start, ros):
    from hmsa.interfaces import topics
    from hmsa_ros.nodes import ros_entities

    ros.collect(topics.FLUX_DENSITY_COMMAND, 'flux_density_command')
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=0.5')
    ros.spin_until(lambda: ros.node.count_publishers('flux_density_command'), 'the planner')
    send = start.hmsa('send', '1.1:0.1', '--wait')
    assert send.wait(30.0) == 1, send.output
    assert 'no node reports applied levels' in send.stderr
    ros_entities.publisher(ros.node, topics.JOINT_STATES)
    send = start.hmsa('send', '1.2:0.1', '--wait')
    assert send.wait(30.0) == 0, send.output
    assert 'done: at_rest, predicted, not measured' in send.stdout


@pytest.mark.slow
@pytest.mark.ros
def test_send_fails_where_the_actuator_is_measured_to_miss_the_setpoint(start, ros):
    start.hmsa('plant', '--ros-args', '-p', 'mismatch.shear_modulus:=1.1')
    ros.spin_until(lambda: ros.node.count_publishers('joint_states'), 'the plant')
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=2.0')
    send = start.hmsa('send', '1.0:0.5', '1.4:0.5', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 1, send.output
    found = re.search(
        r'setpoint 2 of 2: rests (\S+) \(\S+ %\) short of 1.4 and rings at (\S+) Hz, '
        r'(\S+) \(\S+ %\) peak to peak', send.stderr)
    assert found, send.stderr
    # As simulated with the true block.
    assert list(map(float, found.groups())) == pytest.approx([0.0393, 89.9, 0.0366], rel=0.1)
    # A plan that ends at the setpoint already stays: what it missed before is another matter.
    send = start.hmsa('send', '1.4:0.5', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 1, send.output
    assert 'setpoint 2 of 2: rests ' in send.stderr
    send = start.hmsa('send', '1.4:0.5', '1.001:2', '1.0:2', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 1, send.output
    send = start.hmsa('send', '1.0:0.5', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 0, send.output
    assert 'the plan is unchanged\ndone: at_rest, measured' in send.stdout


@pytest.mark.slow
@pytest.mark.ros
def test_send_moves_several_joints_each_to_its_stretch_or_all_to_one(start, ros):
    from hmsa.interfaces import topics

    plans = ros.collect(topics.PLAN, 'planner/plan')
    joints = ['--ros-args', '-p', 'joints:=[left, right]']
    start.hmsa('plant', *joints)
    ros.spin_until(lambda: ros.node.count_publishers('joint_states'), 'the plant')
    start.hmsa('planner', *joints, '-p', 'lead_time:=2.0')
    send = start.hmsa(
        'send', '1.1,0.9:0.2', '1.2:0.2', '--joint', 'right,left', '--wait', '--timeout', '200')
    assert send.wait(300.0) == 0, send.output
    assert 'done: at_rest' in send.stdout
    ros.spin_until(lambda: plans, 'the plan')
    # At rest at the first setpoint, and at the second.
    reached = [dict(zip(plans[-1].joint_names, point.positions, strict=True))
               for point in plans[-1].points]
    for joint, stretch in (('left', 0.9), ('right', 1.1)):
        assert any(abs(x[joint] - stretch) < 1e-6 for x in reached)
    assert all(abs(x - 1.2) < 1e-6 for x in reached[-1].values())
    for count in ('1.1,1.2,1.3:1', '1.1,1.2:1'):
        names = 'left,right' if count.count(',') == 2 else 'left'
        send = start.hmsa('send', count, '--joint', names)
        assert send.wait(300.0) == 2
        assert 'expected one for all, or one per joint' in send.stderr
    send = start.hmsa('send', '1.1:1')
    assert send.wait(300.0) == 2
    assert 'names among left, right; name the joints with --joint' in send.stderr


@pytest.mark.slow
@pytest.mark.ros
def test_send_passes_on_why_the_planner_refuses(start):
    start.hmsa('planner')
    send = start.hmsa('send', '9:1')
    assert send.wait(30.0) == 2
    *notes, error = send.stderr.strip().splitlines()
    assert 'the planner refused: target stretch is 9' in error
    # The planner may still be starting.
    assert all(x.endswith(' ...') for x in notes)


@pytest.mark.ros
def test_send_without_a_planner_says_how_to_start_one(start):
    send = start.hmsa('send', '1.1:1', '--timeout', '0.5')
    assert send.wait(30.0) == 1
    assert 'no planner in namespace /; start one with hmsa planner' in send.stderr


@pytest.mark.ros
def test_a_client_names_the_namespace_of_a_planner_that_it_does_not_find(start):
    start.hmsa('planner', '--ros-args', '-r', '__ns:=/arm')
    for command in (('send', '1.1:1', '--timeout', '4'), ('stop', '--timeout', '4')):
        client = start.hmsa(*command)
        assert client.wait(30.0) == 1
        assert 'no planner in namespace /, but in /arm: name it with --namespace /arm' in (
            client.stderr)


# Help ----------------------------------------------------------------------------------------

def test_a_long_operation_says_what_is_under_way_and_how_long_where_no_bar_is_shown(
        capsys, wait_until, monkeypatch):
    monkeypatch.setattr(terminal, 'PATIENCE', 0.05)
    said = []

    def heard(line):
        said.extend(capsys.readouterr().err.splitlines())
        return any(re.fullmatch(line, x) for x in said)

    with progress() as update:
        for what in ('starting', 'working (1 of 2)', 'working (2 of 2)', 'closing'):
            update(what, 0.5)
            lasting = rf'{re.escape(what)}, \d+ s \.\.\.'
            wait_until(lambda line=lasting: heard(line))
    said += capsys.readouterr().err.splitlines()
    assert [x for x in said if ' s ...' not in x] == [
        'starting ...', 'working (1 of 2) ...', 'closing ...']


def test_an_operation_that_begins_is_said_once_without_a_time(capsys, wait_until, monkeypatch):
    monkeypatch.setattr(terminal, 'PATIENCE', 0.005)
    said = []

    class Activities(list):
        def append(self, activity):
            super().append(activity)
            teller._thread.join(0.05)  # which speaks meanwhile if it can

    with terminal.under_way('outside'):
        teller, = terminal._tellers
        teller.activities = Activities(teller.activities)
        with terminal.under_way('inside'):
            wait_until(lambda: said.append(capsys.readouterr().err) or 'inside' in said[-1])
    inside = [x for x in ''.join(said).splitlines() if x.startswith('inside')]
    assert inside[0] == 'inside ...'
    assert inside.count('inside ...') == 1


@pytest.mark.parametrize('name', sorted({*registered(COMMANDS)} - {*registered(NODES)}))
def test_a_command_says_what_it_does_from_its_start_on(name, capsys, wait_until, monkeypatch):
    words = [name, *{'param': ['get', 'planner'], 'bag': ['info', 'run'],
                     'calibrate': ['coil', 'lab:Coil', '--limit', '1'],
                     'check-driver': ['lab:Coil'], 'compare': ['run'], 'completion': ['bash'],
                     'export': ['run', '--out', 'run.csv'], 'identify': ['run'],
                     'interlock': ['open'],
                     'learn': ['run'], 'plan': ['1.1:1'], 'report': ['run'], 'run': ['1.1:1'],
                     'send': ['1.1:1'], 'simulate': ['levels.csv'], 'tune': ['1.1:1'],
                     'wave': ['sine', '--frequency', '1', '--amplitude', '0.1']}.get(name, [])]
    arguments = build_parser(name).parse_args(words)
    said = []

    @wraps(arguments.run)
    def run(_):
        # Before anything that is slow: with what the command imports, its work has not begun.
        with terminal.under_way('inside'):
            wait_until(lambda: said.append(capsys.readouterr().err) or 'inside' in said[-1])
        wait_until(lambda: said.append(capsys.readouterr().err) or 'hmsa' in said[-1])
        with terminal.under_way():
            capsys.readouterr()
        return 0

    monkeypatch.setattr(terminal, 'PATIENCE', 0.02)
    monkeypatch.setattr(sys.modules[arguments.run.__module__], arguments.run.__name__, run)
    assert main(words) == 0
    assert re.search(rf'^hmsa {name}.*, \d+ s \.\.\.$', said[-1], re.MULTILINE)


def parsers(parser, path='hmsa'):
    """Return all parsers by the command's words."""
    found = {path: parser}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, each in action.choices.items():
                found |= parsers(each, f'{path} {name}')
    return found


PARSERS = parsers(build_parser())


@pytest.mark.parametrize('path', PARSERS)
def test_every_help_ends_with_an_example_that_can_be_copied_and_is_understood(path):
    text = PARSERS[path].format_help().rstrip()
    _, found, example = text.partition('\nexample: ')
    assert found
    words = shlex.split(example.replace('\\\n', ' '))
    assert words[:len(path.split())] == path.split()
    PARSERS['hmsa'].parse_args(split_ros_args(words[1:]))
    assert max(map(len, text.splitlines())) <= 100


def test_options_of_one_name_mean_one_thing():
    meanings = {}
    for command in commands_of(PARSERS['hmsa']):
        for option in command.options:
            for name in option.names:
                meanings.setdefault(name, set()).add(option.value)
    # A file, or a folder where there are several; run has a folder for its report already, and
    # takes one mode of feedback where robustness compares them.
    several = {name for name, values in meanings.items() if len(values) > 1} - {
        '--out', '--report', '--feedback'}
    assert several == set()


# Completion ----------------------------------------------------------------------------------

@pytest.fixture(scope='module')
def scripts(tmp_path_factory):
    """Return the folder with the scripts of all shells."""
    folder = tmp_path_factory.mktemp('completion')
    for shell in ('bash', 'zsh', 'fish'):
        with (folder / shell).open('w') as file, redirect_stdout(file):
            assert main(['completion', shell]) == 0
    return folder


def complete(script, folder, *words):
    """Return bash's completions of the last word."""
    assert shutil.which('bash')
    done = subprocess.run(
        ['bash', '-c', 'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _hmsa; '
         'printf "%s\\n" "${COMPREPLY[@]}"', script / 'bash', 'hmsa', *words],
        capture_output=True, text=True, check=True, cwd=folder)
    assert done.stderr == ''
    return done.stdout.split('\n')[:-1]


@pytest.mark.parametrize(('words', 'offered'), [
    (['pla'], ['plan', 'planner', 'plant', 'player']),
    (['bag', ''], ['info', 'recover', 'verify', '-h', '--help']),
    (['bag', 'info', '--j'], ['--json']), (['bag', 'info', 'a b.m'], ['a b.mcap']),
    (['plan', '1.1:10', '--sh'], ['--shaper']), (['plan', '--shaper', 'z'], ['zv', 'zvd']),
    (['plan', '--zeta', ''], ['']), (['report', 'a'], ['a b.mcap', 'a_folder']),
    (['demo', '--out', 'a'], ['a_folder']),
    (['completion', ''], ['bash', 'zsh', 'fish', '-h', '--help']),
    (['planner', '--r'], ['--ros-args']), (['planner', '--ros-args', '--p'], ['--params-file']),
    (['planner', '--ros-args', '--params-file', 'a b'], ['a b.mcap']), (['nonsense'], [''])])
def test_bash_completes_commands_options_and_files(scripts, tmp_path, words, offered):
    (tmp_path / 'a b.mcap').touch()
    (tmp_path / 'a_folder').mkdir()
    found = complete(scripts, tmp_path, *words)
    assert sorted(found) == sorted(offered)


def test_bash_offers_every_command_and_option_there_is(scripts, tmp_path):
    for command in commands_of(PARSERS['hmsa']):
        offered = complete(scripts, tmp_path, *command.path.split(), '')
        assert {*command.words, *(y for x in command.options for y in x.names)} <= set(offered)
    assert set(SHAPERS) <= set(complete(scripts, tmp_path, 'plan', '--shaper', ''))


def test_the_tab_key_completes_in_a_real_bash(scripts, tmp_path):
    ours, theirs = pty.openpty()
    with subprocess.Popen(
            ['bash', '--norc', '--noprofile', '-i'], stdin=theirs, stdout=theirs, stderr=theirs,
            start_new_session=True, cwd=tmp_path,
            env={'PATH': os.environ['PATH'], 'TERM': 'dumb', 'PS1': '> '}) as process:
        os.close(theirs)
        os.write(ours, f'source {scripts / "bash"}\nhmsa robus\t--shap\t'.encode())
        text, end = '', time.monotonic() + WAIT_SECONDS
        while 'hmsa robustness --shapers ' not in text:
            assert time.monotonic() < end, text
            if select.select([ours], [], [], 0.1)[0]:
                text += os.read(ours, 65536).decode()
        process.kill()
    os.close(ours)


@pytest.mark.parametrize(('shell', 'check'), [
    ('zsh', ['zsh', '-n']), ('fish', ['fish', '--no-execute'])])
def test_scripts_of_other_shells_are_read_by_them(scripts, shell, check):
    text = (scripts / shell).read_text()
    for command in commands_of(PARSERS['hmsa']):
        assert not command.path or command.path in text
    if shutil.which(shell) is None:
        pytest.skip(f'{shell} is not installed: its script was NOT tried')
    done = subprocess.run([*check, scripts / shell], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    if shell == 'fish':
        done = subprocess.run(
            ['fish', '-c', f'source {scripts / shell}; complete -C "hmsa bag re"'],
            capture_output=True, text=True, check=False)
        assert done.stdout.startswith('recover\t')


# Colour and progress -------------------------------------------------------------------------

COLOUR = re.compile(rb'\x1b\[(?:\d+;)*(?:3[0-7]|4[0-7]|9[0-7]|38|48)[;m]')


def on_terminal(code, **env):
    """Run Python code on a terminal, and return its output there."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
    shown = b''
    with subprocess.Popen(
            [sys.executable, '-c', code], cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs,
            start_new_session=True,
            env={**os.environ, 'TERM': 'xterm-256color', **env}) as process:
        os.close(theirs)
        try:
            while data := os.read(ours, 65536):
                shown += data
        except OSError:  # the other end is closed
            pass
    os.close(ours)
    assert process.returncode == 0, shown
    return shown


PROGRESS = """
from hmsa.cli.terminal import progress
with progress('waiting') as update:
    update('drawing', 0.5)
print('done')
"""
TABLE = "from hmsa.cli import main; main(['plan', '1.1:10'])"


def test_progress_is_shown_on_a_terminal_and_gone_at_the_end(capsys):
    shown = on_terminal(PROGRESS)
    assert b'drawing' in shown
    assert b' 50 %' in shown
    assert COLOUR.search(shown)
    with progress() as update:
        update('nothing of this is seen', 0.5)
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ('', '')


def test_a_notebook_which_asks_for_colours_gets_no_progress():
    shown = subprocess.run(
        [sys.executable, '-c', PROGRESS], cwd=ROOT, env={**os.environ, 'FORCE_COLOR': '1'},
        capture_output=True, text=True, check=True)
    assert (shown.stdout, shown.stderr) == ('done\n', '')


def test_a_table_is_printed_where_the_locale_lacks_its_characters():
    shown = subprocess.run(
        [sys.executable, '-c', TABLE], cwd=ROOT, env={**os.environ, 'PYTHONIOENCODING': 'ascii'},
        capture_output=True, text=True, check=True)
    assert 'two_step' in shown.stdout


def test_the_locale_c_gets_plain_characters_and_file_names_as_they_are(tmp_path):
    levels = tmp_path / 'lev\u00e9l.csv'
    levels.write_text('time,flux_density\n0,0.01\n0.1,0\n', encoding='utf-8')
    # As scripts, cron and containers have it; without it, Python takes UTF-8 by itself.
    env = {**os.environ, 'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
    for words in (['plan', '1.1:10'], ['init', '--yes', '--out', 'b.yaml'],
                  ['simulate', str(levels), '--params-file', 'b.yaml', '--out', f'{levels}2.csv']):
        shown = subprocess.run(
            [sys.executable, '-m', 'hmsa_ros', *words], cwd=tmp_path, env=env,
            capture_output=True, check=True)
        assert b'?' not in shown.stdout
    assert b'-------  ' in shown.stdout
    assert f'{levels}2.csv'.encode() in shown.stdout


def test_nothing_is_wrong_where_standard_output_is_closed():
    shown = subprocess.run(
        ['sh', '-c', f'{shlex.quote(sys.executable)} -m hmsa_ros plan 1.1:10 >&-'], cwd=ROOT,
        capture_output=True, text=True, check=True)
    assert without_progress(shown.stderr) == ''


@pytest.mark.parametrize('code', [PROGRESS, TABLE])
@pytest.mark.parametrize('env', [{'NO_COLOR': '1'}, {'TERM': 'dumb'}])
def test_no_colour_where_none_is_wanted(code, env):
    assert not COLOUR.search(on_terminal(code, **env))


@pytest.mark.ros
def test_the_log_of_a_node_has_no_colour_where_none_is_wanted(ros_env):
    code = """
import rclpy, sys
from hmsa_ros.nodes.managed import run
class Node(rclpy.node.Node):
    def __init__(self):
        super().__init__('talker')
        self.get_logger().warning('careful')
        self.finished = True
run(Node)
"""
    shown = on_terminal(code, NO_COLOR='1', RCUTILS_COLORIZED_OUTPUT='')
    assert b'careful' in shown
    assert not COLOUR.search(shown)
