"""The live view: its display of scenes, and all of it on a terminal."""

from contextlib import suppress
from dataclasses import replace
import fcntl
import json
import os
import pty
import random
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time

import numpy as np
import pyte
import pytest

from hmsa_ros.interfaces.status import Verdict
from hmsa_ros.watch.scene import History, Joint, Report, Scene
from hmsa_ros.watch.screen import as_json, limits, line, Screen, strip

WAIT_SECONDS = 60.0
COLOUR = re.compile(rb'\x1b\[(?:\d+;)*(?:3[0-7]|4[0-7]|9[0-7]|38|48)[;m]')


def history(values, span=10.0):
    """Return a history that ends at time 100 with equally spaced values."""
    result = History(span)
    result.put(100.0 - span, 100.0, np.asarray(values, dtype=float))
    return result


def joint(name='actuator', stretch=1.1, target=1.2):
    return Joint(
        name, history(np.linspace(1.0, stretch, 1000)), history(np.full(1000, target)),
        stretch, 0.5, 0.0345, target, 0.065, 'stretch')


def scene(*joints):
    return Scene(
        'domain 42  /', 100.0, stamp=12.5, age=0.01, sample_rate=1000.0,
        joints=joints or (joint(),), progress=0.25,
        request=Verdict(0, 'accepted', 'accepted', '', 'moving', 1, 3),
        reports=[Report('planner', 1, '2 commands sent late', {'sent': 6, 'late': 2}),
                 Report('plant', 0, 'commands in time', {'late': 0}, age=9.0)])


# Charts --------------------------------------------------------------------------------------

def test_a_history_keeps_every_peak_whatever_the_width():
    values = np.ones(10_000)
    values[3_210], values[7_777] = 5.0, -3.0
    kept = history(values)
    for columns in (1, 7, 60, 140, 480):
        low, high = kept.ranges(100.0, columns)
        assert (np.nanmin(low), np.nanmax(high)) == (-3.0, 5.0)
        assert len(low) == columns
    low, high = kept.ranges(100.0, 100)
    assert np.flatnonzero(high == 5.0).tolist() == [32]
    assert np.flatnonzero(low == -3.0).tolist() == [77]


def test_a_history_forgets_what_has_left_the_chart():
    kept = history(np.full(100, 2.0))
    low, high = kept.ranges(105.0, 100)
    assert np.all(high[:49] == 2.0)
    assert np.all(np.isnan(low[51:]))
    assert np.all(np.isnan(kept.ranges(1e6, 10)[0]))


def test_a_target_that_holds_is_a_line_without_gaps():
    history = History(10.0)
    # Looks are further apart than the slots of a history.
    for i in range(100):
        history.hold(0.1 * i, 0.1 * (i + 1), 1.2)
    assert np.array_equal(history.ranges(10.0, 140), np.full((2, 140), 1.2))
    history.hold(10.0, 1e6, 1.3)
    assert np.array_equal(history.ranges(1e6, 140), np.full((2, 140), 1.3))


def test_words_that_do_not_fit_are_left_out_whole():
    for width in range(30, 80):
        lines = [x.plain for x in Screen(10.0).lines(scene(), width, 24)]
        place = next(i for i, x in enumerate(lines) if x.startswith('actuator'))
        assert re.fullmatch(
            r'actuator  stretch 1\.10000(  target 1\.20000(  error -1\.0e-01'
            r'(  rate \+0\.500 1/s)?)?)?', lines[place])
        assert re.fullmatch(
            r'flux density \+34\.500 mT(  commanded \+65\.000 mT)?', lines[place + 1])


def test_a_chart_draws_a_line_where_its_values_are():
    flat = np.full(20, 0.0), np.full(20, 0.0)
    none = np.full(20, np.nan), np.full(20, np.nan)
    drawn = strip(flat, none, 3, (-1.0, 1.0), braille=True)
    assert [set(x) for x in drawn.rows] == [{'⠀'}, {'⠤'}, {'⠀'}]
    assert [len(x) for x in drawn.rows] == [10, 10, 10]
    drawn = strip(flat, none, 3, (-1.0, 1.0), braille=False)
    assert drawn.rows == (' ' * 20, '*' * 20, ' ' * 20)


def test_a_target_is_told_apart_from_the_value_without_colour():
    value = np.full(20, 0.0), np.full(20, 0.0)
    target = np.full(20, 1.0), np.full(20, 1.0)
    braille = strip(value, target, 4, (-1.0, 1.0), braille=True)
    assert '⠀' not in braille.rows[2]
    assert len(set(braille.rows[0])) > 1
    assert braille.targets[0] == tuple(range(10))
    assert braille.targets[2] == ()
    plain = strip(value, target, 3, (-1.0, 1.0), braille=False)
    assert plain.rows == ('-' * 20, '*' * 20, ' ' * 20)


@pytest.mark.parametrize('values', [[], [1.0], [1.0, 2.0], [np.nan, 1.5], [np.nan]])
def test_an_axis_has_room_around_all_values(values):
    array = np.array(values, dtype=float)
    low, high = limits(array, least=0.1)
    assert high - low >= 0.1 - 1e-12
    known = array[np.isfinite(array)]
    assert np.all((low < known) & (known < high))


# Screens -------------------------------------------------------------------------------------

@pytest.mark.parametrize(('width', 'height'), [
    (80, 24), (40, 10), (200, 60), (20, 5), (1, 1), (80, 6)])
@pytest.mark.parametrize('count', [0, 1, 2, 7, 64])
@pytest.mark.parametrize('unicode', [True, False])
def test_a_frame_fits_the_terminal(width, height, count, unicode):
    seen = scene(*(joint(f'joint_{i}') for i in range(count)))
    seen = replace(seen, joints=seen.joints if count else ())
    lines = Screen(10.0, unicode=unicode).lines(seen, width, height)
    assert 1 <= len(lines) <= height
    assert max(x.cell_len for x in lines) <= width
    if not unicode:
        assert all(x.plain.isascii() for x in lines)


def test_a_frame_of_80_by_24_says_everything():
    lines = [x.plain for x in Screen(10.0).lines(scene(), 80, 24)]
    text = '\n'.join(lines)
    for words in (
            'domain 42', '12.500 s (simulated)', '1000 samples/s', 'q ends', 'stretch 1.10000',
            'target 1.20000', 'error -1.0e-01', 'rate +0.500 1/s', 'flux density +34.500 mT',
            'commanded +65.000 mT', '└-10 s───', '-5 s──', '──now',
            'setpoint 1 of 3  moving', '25 %',
            'verdict  OK    accepted', 'planner  WARN  2 commands sent late, late 2, sent 6',
            'plant    STALE silent for 9 s'):
        assert words in text
    assert len(lines) == 24


def test_a_refusal_is_shown_to_its_end():
    reason = (
        'the stretch of point 3 is 2.4: expected between 0.643172 and 1.905871, where the flux '
        'density of -0.2 T to 0.2 T holds the actuator and its chains are not at their end')
    seen = replace(scene(), request=Verdict(2, reason, 'out_of_range', '', 'idle', 0, 0))
    lines = [x.plain for x in Screen(10.0).lines(seen, 80, 24)]
    place = next(i for i, x in enumerate(lines) if x.startswith('verdict  ERROR '))
    assert reason in ' '.join(x[15:].strip() for x in lines[place:place + 4])
    assert max(map(len, lines)) <= 80


def test_many_joints_have_a_line_each_and_the_rest_is_counted():
    seen = scene(*(joint(f'joint_{i}', 1.0 + 0.01 * i) for i in range(64)))
    lines = [x.plain for x in Screen(10.0).lines(seen, 80, 24)]
    shown = [x for x in lines if x.startswith('joint_')]
    assert f'and {64 - len(shown)} more: name some with --joint' in lines
    assert shown[5].split()[:3] == ['joint_5', '1.05000', '1.20000']
    seen.joints[3].coordinate = 'deflection'
    mixed = Screen(10.0).lines(seen, 80, 24)
    assert [x[1].plain.split()[1] for x in (mixed, Screen(10.0).lines(
        replace(seen, joints=seen.joints[3:4] * 20), 80, 24))] == ['position', 'deflection']
    assert len(shown) > 10


def test_a_line_tells_of_trouble_only_where_there_is_some():
    assert line(scene()) == (
        '12.500 s (simulated); actuator 1.10000 (target 1.20000, +34.500 mT); moving 1/3, OK '
        'accepted; planner: 2 commands sent late, late 2')
    assert line(Scene('domain 1  /', waiting=['no planner seen'])) == 'no planner seen'


def test_json_has_null_for_what_is_not_known():
    made = json.loads(json.dumps(as_json(scene())))
    assert made['joints'] == [{
        'name': 'actuator', 'stretch': 1.1, 'stretch_rate': 0.5, 'flux_density': 0.0345,
        'target': 1.2, 'flux_density_command': 0.065}]
    assert made['request']['state'] == 'moving'
    made = as_json(Scene('domain 1  /'))
    assert made['stamp'] is None
    assert made['request'] is None


# The command ---------------------------------------------------------------------------------

class Terminal:
    """``hmsa watch`` on a separate terminal."""

    def __init__(self, env, *words, columns=80, rows=24, **more):
        self.file, theirs = pty.openpty()
        self.before = termios.tcgetattr(theirs)
        self._resize(columns, rows)
        self.screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self.screen)
        self.raw = b''
        self._theirs = theirs
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'hmsa_ros', 'watch', *words], stdin=theirs, stdout=theirs,
            stderr=theirs, start_new_session=True,
            env={**env, 'TERM': 'xterm-256color', 'COLUMNS': '', 'LINES': '', **more})

    def _resize(self, columns, rows):
        fcntl.ioctl(self.file, termios.TIOCSWINSZ, struct.pack('HHHH', rows, columns, 0, 0))

    def resize(self, columns, rows):
        self._resize(columns, rows)
        self.screen.resize(rows, columns)

    def _read(self):
        ready, _, _ = select.select([self.file], [], [], 0.1)
        if ready:
            data = os.read(self.file, 65536)
            self.raw += data
            self._stream.feed(data)

    def wait_for(self, *words):
        end = time.monotonic() + WAIT_SECONDS
        while not all(x in self.text for x in words):
            assert time.monotonic() < end, self.text
            assert self.process.poll() is None, self.text
            self._read()
        return self.text

    @property
    def text(self):
        return '\n'.join(self.screen.display)

    def end(self, key=b'q', number=None):
        """Press a key, or send a signal, and return the exit status."""
        if number is None:
            os.write(self.file, key)
        else:
            self.process.send_signal(number)
        end = time.monotonic() + WAIT_SECONDS
        while self.process.poll() is None:
            assert time.monotonic() < end
            self._read()
        while select.select([self.file], [], [], 0.1)[0]:
            self._read()
        assert termios.tcgetattr(self._theirs) == self.before
        return self.process.returncode

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.file)
        os.close(self._theirs)


@pytest.fixture
def terminal(ros_env):
    opened = []

    def make(*words, **options):
        opened.append(Terminal(ros_env, *words, **options))
        return opened[-1]

    yield make
    for each in opened:
        each.close()


@pytest.mark.ros
def test_each_joint_has_its_own_target_command_and_history(ros, ros_env, wait_until):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import Vector3
    from sensor_msgs.msg import JointState, MagneticField
    from std_msgs.msg import Header

    from hmsa_ros.interfaces import topics
    from hmsa_ros.nodes import endpoints
    from hmsa_ros.nodes.conversions import to_time
    from hmsa_ros.watch.listener import Listener

    def status(name, level, joint, **values):
        return DiagnosticStatus(
            name=name, level=level, hardware_id=joint, message='said',
            values=[KeyValue(key=x.replace('__', '.'), value=y) for x, y in values.items()])

    publish = {
        name: ros.node.create_publisher(kind, name, qos).publish for name, kind, qos in (
            ('joint_states', JointState, 100), ('diagnostics', DiagnosticArray, 10),
            ('planner/status', DiagnosticStatus, endpoints.profile(topics.LATCHED)),
            ('right/flux_density_command', MagneticField, 100))}
    publish['planner/status'](status(
        'planner: request', DiagnosticStatus.OK, 'left, right', state='moving', stretch='',
        left__stretch='1.1', right__stretch='0.9', right__coordinate='deflection', setpoint='1',
        setpoints='2'))
    seen = []
    with Listener(span=10.0) as listener:
        def there():
            number = len(seen)
            stamp = Header(stamp=to_time(10**9 + number))
            publish['joint_states'](JointState(
                header=stamp, name=['left', 'right'],
                position=[1.0 + 0.5 * (number % 9 == 5), 0.95], velocity=[0.5],
                effort=[0.01, -0.04]))
            publish['right/flux_density_command'](MagneticField(
                header=stamp, magnetic_field=Vector3(z=-0.02)))
            publish['diagnostics'](DiagnosticArray(status=[
                status('planner: commands', DiagnosticStatus.OK, 'left', late='1'),
                status('planner: time', DiagnosticStatus.WARN, '', late='2'),
                status('battery: charge', DiagnosticStatus.ERROR, 'pack', cells='7')]))
            seen.append(listener.look())
            return seen[-1].request and seen[-1].reports and all(
                np.isfinite(x.target) for x in seen[-1].joints) and np.isfinite(
                    seen[-1].joints[1].commanded) and seen[-1].joints[0].stretch == 1.0 and (
                    np.nanmax(seen[-1].joints[0].stretches.ranges(seen[-1].now, 50)[1]) == 1.5)
        # A peak that is over when the view is drawn is still in the chart.
        wait_until(there)
        left, right = seen[-1].joints
        assert (left.name, left.target, left.flux_density) == ('left', 1.1, 0.01)
        assert (right.name, right.target, right.stretch, right.coordinate) == (
            'right', 0.9, 0.95, 'deflection')
        assert (left.rate, np.isnan(right.rate)) == (0.5, True)
        assert (np.isnan(left.commanded), right.commanded) == (True, -0.02)
        report, = seen[-1].reports
        assert (report.name, report.level, report.counts) == ('planner', 1, {'late': 3})
        assert seen[-1].request.setpoints == 2


@pytest.mark.ros
def test_garbage_on_its_topics_neither_ends_nor_misleads_it(ros, ros_env, wait_until):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    from benchmarks.faults import garbage
    from hmsa_ros.interfaces import topics
    from hmsa_ros.nodes import endpoints
    from hmsa_ros.nodes.conversions import to_command
    from hmsa_ros.watch.listener import Listener

    dice = random.Random(7)
    senders = [
        (kind, ros.node.create_publisher(kind, name, qos)) for name, kind, qos in (
            ('joint_states', JointState, 1000), ('diagnostics', DiagnosticArray, 1000),
            ('planner/status', DiagnosticStatus, endpoints.profile(topics.LATCHED)),
            ('planner/plan', JointTrajectory, endpoints.profile(topics.LATCHED)),
            ('flux_density_command', type(to_command(0, 0.0, '')), 1000))]
    screen = Screen(span=10.0, unicode=True)
    with Listener(span=10.0) as listener:
        def aside():
            for kind, publisher in senders:
                for made in (garbage.message, garbage.encoding):
                    # What the middleware itself does not take never arrives.
                    with suppress(Exception):
                        publisher.publish(made(kind, dice))
            # What it is made for, with values that are wild.
            senders[1][1].publish(DiagnosticArray(status=[DiagnosticStatus(
                name='planner: \x1b[2J', message='\x1b]0;mine\x07', level=bytes([255]),
                values=[KeyValue(key='late', value=dice.choice(('²', '9' * 5000, '7')))])]))
            seen = listener.look()
            for text in (line(seen), *(x.plain for x in screen.lines(seen, 100, 30))):
                assert text.isprintable()
            json.dumps(as_json(seen), allow_nan=False)
            return {name for name in ('joint_states', 'diagnostics', 'status', 'plan', 'command')
                    if any(f'{name} ignored' in x for x in seen.waiting)}

        names = wait_until(lambda: len(found := aside()) == 5 and found)
        assert len(names) == 5
        good = JointState(name=['finger'], position=[1.25], velocity=[0.0], effort=[0.01])
        senders[0][1].publish(good)
        wait_until(lambda: {x.name: x for x in listener.look().joints}['finger'].stretch == 1.25)


@pytest.mark.slow
@pytest.mark.ros
def test_the_view_follows_a_real_run_and_leaves_the_terminal_clean(start, terminal):
    start.hmsa('plant')
    start.hmsa('planner')
    # Long enough for the motion to be still in the chart on a busy machine, on which commands
    # may be late, too.
    view = terminal('--span', '600')
    view.wait_for('verdict  OK', 'no request yet', 'stretch 1.00000', 'samples/s')
    send = start.hmsa('send', '1.1:0.3', '1.2:0.3', '--wait')
    assert send.wait(WAIT_SECONDS) == 0, send.output
    text = view.wait_for(
        'stretch 1.20000', 'target 1.20000', 'commanded +64.915 mT', 'setpoint 2 of 2  at rest',
        '100 %', 'planner  ', 'plant  ', ', late ')
    assert 'no request yet' not in text
    assert COLOUR.search(view.raw)
    # The step up is in the chart: the axis reaches from rest to the target.
    label = re.compile(r'^ +(\d\.\d{4}) │', re.MULTILINE)
    high, low = map(float, label.findall(text))
    assert low < 1.0
    assert high > 1.2
    view.resize(60, 12)
    view.wait_for('setpoint 2 of 2  at rest')
    assert max(len(x.rstrip()) for x in view.screen.display) <= 60
    assert view.end() == 0
    # Back on the ordinary screen, with a cursor.
    assert view.raw.rstrip().endswith(b'\x1b[?1049l')
    assert view.raw.count(b'\x1b[?25h') >= 1


@pytest.mark.ros
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_with_nothing_there_it_says_what_it_waits_for(terminal, ros_domain_id, number):
    view = terminal(NO_COLOR='1')
    text = ' '.join(view.wait_for('no plant or driver', 'no planner').split())
    assert f'no planner seen on domain {ros_domain_id}: is it running, with the same ' \
        'ROS_DOMAIN_ID' in text
    assert view.end(number=number) == 0
    assert not COLOUR.search(view.raw)
    assert view.raw.rstrip().endswith(b'\x1b[?1049l')


@pytest.mark.slow
@pytest.mark.ros
def test_a_dumb_terminal_and_a_pipe_get_lines(start, terminal, wait_until):
    start.hmsa('plant', '--ros-args', '-p', 'joint:=finger')
    lines = start.hmsa('watch')
    objects = start.hmsa('watch', '--json')
    view = terminal(TERM='dumb')
    view.wait_for('finger 1.00000', 'no planner seen')
    assert b'\x1b' not in view.raw
    lines.wait_for_output('finger 1.00000')
    objects.wait_for_output('"name": "finger"')
    assert view.end(number=signal.SIGINT) == 0
    assert lines.stop() == 0
    assert objects.stop() == 0
    newest = json.loads(objects.stdout.splitlines()[-1])
    assert newest['joints'][0]['stretch'] == 1.0
    assert newest['request'] is None
    # There is no planner, which both wait for until their time is over.
    once = start.hmsa('watch', '--once', '--timeout', '10')
    missed = start.hmsa('watch', '--once', '--json', '--joint', 'thumb', '--timeout', '10')
    assert once.wait() == 0
    assert 'stretch 1.00000' in once.stdout
    assert missed.wait() == 1
    assert 'no joint thumb on /joint_states: it has finger' in missed.stdout


@pytest.mark.parametrize(('words', 'said'), [
    (['--span', '0'], 'span is 0: expected 0.1 to 3600'),
    (['--rate', 'nan'], 'rate is nan'),
    (['--rate', '1000'], 'rate is 1000: expected 0.1 to 30'),
    (['--timeout', '-1'], 'timeout is -1'),
    (['--namespace', '9 bad'], "namespace '9 bad'"),
])
def test_bad_input_is_answered_in_one_line_with_status_2(words, said, capsys, ros_env):
    from hmsa_ros.cli import main

    assert main(['watch', *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert re.fullmatch(r'hmsa: error: [^\n]+\n', captured.err)
    assert said in captured.err
