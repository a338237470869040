"""End of processes on signals: at the start, at work, and twice."""

from contextlib import suppress
from random import Random
import signal
import subprocess
import sys

from conftest import Starter, wait_until, without_progress
import pytest

pytestmark = pytest.mark.ros

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
NODES = ('planner', 'plant', 'recorder', 'player')
# Runs an entry point, with a signal as soon as a module is asked for.
AT_IMPORT = """
import os, sys
class Sender:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), {number})
        return None
sys.meta_path.insert(0, Sender())
from hmsa_ros import entry
sys.argv[1:] = []
sys.exit(entry.{entry}())
"""
# Runs an entry point, with a signal as soon as its node runs; prints the threads that are left.
ONCE_IT_RUNS = """
import os, signal, sys
from pathlib import Path
from hmsa_ros import entry
from hmsa_ros.nodes import managed
spin = managed.spin
def told_to_end(*arguments):
    os.kill(os.getpid(), signal.SIGTERM)
    spin(*arguments)
managed.spin = told_to_end
sys.argv[1:] = []
entry.{entry}()
names = {{x.read_text().strip() for x in Path('/proc/self/task').glob('*/comm')}}
print(sorted(x for x in names if x.startswith('dds.')))
"""
# Begins `hmsa send`, with an interrupt where Python drops an exception.
IN_A_DESTRUCTOR = """
import os, signal, sys
from hmsa.entry import main
from hmsa_ros.clients.client import PlannerClient
class Trap:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
find = PlannerClient.find_planner
def find_planner(self, each=None):
    Trap()
    find(self, each)
PlannerClient.find_planner = find_planner
sys.exit(main(['send', '1.1:1', '--timeout', '1000']))
"""


# Runs the command line, and says when signals are no longer answered by Python itself.
TOLD = """
import os, sys
from hmsa import entry
take_over = entry._take_over
entry._take_over = lambda: (take_over(), os.write(1, b'.'))
sys.exit(entry.main(sys.argv[1:]))
"""
# Ends in native code that holds the interpreter for ever.
IN_NATIVE_CODE = """
import atexit, ctypes, sys
from hmsa import ending, entry
ending._LAST_SECONDS = 1
atexit.register(ctypes.PyDLL(None).pause)
sys.exit(entry.main({arguments!r}))
"""
# Python is not taken apart, but what is registered for its end is done, and lines are written.
AT_EXIT = """
import atexit, ctypes, sys
from hmsa import ending, entry
class Held:
    def __del__(self):
        print('taken apart')
held = Held()
atexit.register(print, 'at exit')
sys.modules['rclpy'] = None
ctypes.CDLL(None).printf(b'of a library')
sys.exit(entry.main({arguments!r}))
"""
# A call that returns when a line comes, and may take half a second.
IN_A_CALL = """
import sys
from hmsa.ending import Deadline, encoded
deadline = Deadline()
deadline.set_text(encoded('it takes too long'))
deadline.set(0.5)
print('armed', flush=True)
sys.stdin.readline()
deadline.set(0.0)
"""
# A node whose callbacks take longer than the time between them.
BUSY = """
import sys
from time import sleep
from rclpy.node import Node
from hmsa_ros.nodes.managed import run
class Busy(Node):
    def __init__(self):
        super().__init__('busy')
        for _ in range(2):
            self.create_timer(0.001, self.work)
    def work(self):
        print('busy', flush=True)
        sleep(0.005)
sys.exit(run(Busy, []))
"""
# A node that has received more messages than it reads in half a minute.
BEHIND = """
import sys
from time import sleep
from rclpy.node import Node
from std_msgs.msg import Empty
from hmsa_ros.nodes.managed import run
class Behind(Node):
    def __init__(self):
        super().__init__('behind')
        self.read = 0
        self.create_subscription(Empty, 'topic', self.work, 3000)
        self.sender = self.create_publisher(Empty, 'topic', 3000)
        while not self.sender.get_subscription_count():
            sleep(0.01)
        self.sender.publish(Empty())
    def work(self, _):
        self.read += 1
        if self.read == 1:
            for _ in range(2999):
                self.sender.publish(Empty())
            print('behind', flush=True)
        sleep(0.01)
    def close(self):
        print(self.read)
sys.exit(run(Behind, []))
"""


@pytest.mark.parametrize(('arguments', 'status'), [
    (['plan', '1.1:10'], 0), (['plan', '1.1:10', '--zeta', '-1'], 2)])
def test_a_process_ends_even_where_a_library_does_not(arguments, status):
    done = subprocess.run(
        [sys.executable, '-c', IN_NATIVE_CODE.format(arguments=arguments)],
        capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == status
    assert ('error' in done.stderr) == bool(status)
    assert ('1.1' in done.stdout) == (not status)


@pytest.mark.parametrize(('arguments', 'status'), [(['--version'], 0), (['plan', '0'], 2)])
def test_a_process_does_not_wait_until_python_has_taken_itself_apart(arguments, status):
    done = subprocess.run(
        [sys.executable, '-c', AT_EXIT.format(arguments=arguments)], capture_output=True,
        text=True, check=False, timeout=60)
    assert done.returncode == status
    assert 'at exit' in done.stdout
    assert 'of a library' in done.stdout
    assert 'taken apart' not in done.stdout


def test_time_in_which_a_process_is_stopped_does_not_count_for_a_call():
    def start():
        process = subprocess.Popen(
            [sys.executable, '-c', IN_A_CALL], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True)
        assert process.stdout.readline() == 'armed\n'
        return process

    with start() as stopped:
        stopped.send_signal(signal.SIGSTOP)
        with start() as running:
            assert running.wait(60) == 1
            assert running.stderr.read() == 'hmsa: error: it takes too long\n'
        stopped.stdin.write('\n')
        stopped.stdin.flush()
        stopped.send_signal(signal.SIGCONT)
        assert (stopped.wait(60), stopped.stderr.read()) == (0, '')


@pytest.mark.parametrize(('node', 'module', 'number'), [
    (node, module, NUMBERS[i % 3]) for i, (node, module) in enumerate([
        *((x, 'rclpy') for x in NODES), ('planner', 'numpy')])])
def test_a_node_that_is_told_to_end_while_it_is_imported_ends_without_a_word(
        ros_env, node, module, number):
    # Tests that run in the background of a shell have SIGINT ignored.
    done = subprocess.run(
        ['env', '--default-signal=INT', sys.executable, '-c', AT_IMPORT.format(
            module=module, number=int(number), entry=node)],
        capture_output=True, text=True, check=False, timeout=60)
    expected = (1, 'hmsa: error: the recorder was told to end before its bag was open: no bag is '
                   'written\n') if node == 'recorder' else (0, '')
    assert (done.returncode, done.stderr, done.stdout) == (*expected, '')


def test_a_node_that_is_always_busy_ends_on_a_signal(ros_env):
    with subprocess.Popen(
            [sys.executable, '-c', BUSY], stdout=subprocess.PIPE, env=ros_env) as node:
        for _ in range(100):
            assert node.stdout.readline() == b'busy\n'
        node.send_signal(signal.SIGTERM)
        node.stdout.read()
        assert node.wait(60) == 0


def test_a_node_ends_on_a_signal_before_it_has_read_what_it_received(ros_env):
    with subprocess.Popen(
            [sys.executable, '-c', BEHIND], stdout=subprocess.PIPE, env=ros_env) as node:
        assert node.stdout.readline() == b'behind\n'
        node.send_signal(signal.SIGTERM)
        assert int(node.stdout.read()) < 3000
        assert node.wait(60) == 0


@pytest.mark.parametrize('node', [
    'planner', pytest.param('plant', marks=pytest.mark.slow)])
def test_no_thread_of_fast_dds_outlives_a_node(ros_env, node):
    done = subprocess.run(
        [sys.executable, '-c', ONCE_IT_RUNS.format(entry=node)], capture_output=True, text=True,
        check=True, timeout=60)
    # This one is of the process, and reads nothing.
    assert done.stdout in ('[]\n', "['dds.shm.wdog']\n")


def test_a_process_that_goes_on_is_not_stopped_from_the_keyboard():
    code = ('import os, signal; from hmsa.ending import ENDING; ENDING.go_on(); '
            'os.kill(os.getpid(), signal.SIGTSTP); print("goes on")')
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == 'goes on\n'


def test_an_interrupt_that_python_drops_still_ends_a_command(ros_env):
    done = subprocess.run(
        [sys.executable, '-c', IN_A_DESTRUCTOR], capture_output=True, text=True, check=False,
        timeout=60)
    assert (done.returncode, done.stdout, without_progress(done.stderr)) == (130, '', '')


@pytest.mark.parametrize('module', ['hmsa.ending', 'hmsa._deadline'])
def test_an_end_is_in_order_before_anything_of_ours_is_imported(module):
    code = AT_IMPORT.replace('entry.{entry}()', "entry.main(['plan', '1.1:10'])")
    done = subprocess.run(
        [sys.executable, '-c', code.format(module=module, number=int(signal.SIGINT))],
        capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, without_progress(done.stderr)) == (130, '', '')


@pytest.mark.slow
@pytest.mark.parametrize(('words', 'statuses'), [
    (['plan', '1.1:10'], {0, 130}), (['planner'], {0, 130}),
    (['run', '1.1:1', '--simulate', '--out', 'out'], {0, 130})])
def test_an_interrupt_in_the_first_second_ends_in_order(ros_env, tmp_path, words, statuses):
    random = Random(1)
    for number in range(14):
        folder = tmp_path / str(number)
        folder.mkdir()
        with subprocess.Popen(
                [sys.executable, '-c', TOLD, *words], cwd=folder, stdout=subprocess.PIPE,
                stderr=subprocess.PIPE) as process:
            assert process.stdout.read(1) == b'.'
            with suppress(subprocess.TimeoutExpired):
                process.wait(random.uniform(0.0, 1.0))
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        assert b'Traceback' not in out + err, err.decode()
        assert process.returncode in statuses, err.decode()
        assert words != ['planner'] or all(b'[INFO]' in x for x in err.splitlines()), err.decode()


@pytest.mark.parametrize(('number', 'status'), [
    (signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_computation_is_given_up_in_order(number, status):
    code = AT_IMPORT.replace('entry.{entry}()', "entry.main(['plan', '1.1:10'])")
    done = subprocess.run(
        ['env', '--default-signal=INT', sys.executable, '-c', code.format(
            module='numpy', number=int(number))],
        capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, without_progress(done.stderr)) == (status, '', '')


def test_an_interrupt_that_python_drops_still_ends_a_computation():
    code = AT_IMPORT.replace('entry.{entry}()', "entry.main(['plan', '1.1:10'])").replace(
        'os.kill(os.getpid(), {number})', 'Trap()').replace('class Sender', """class Trap:
    def __del__(self):
        os.kill(os.getpid(), {number})
class Sender""")
    done = subprocess.run(
        ['env', '--default-signal=INT', sys.executable, '-c', code.format(
            module='numpy', number=int(signal.SIGINT))],
        capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, without_progress(done.stderr)) == (130, '', '')


@pytest.mark.parametrize('number', [
    pytest.param(x, id=x.name, marks=[] if x == signal.SIGINT else pytest.mark.slow)
    for x in NUMBERS])
def test_a_recorder_told_to_end_again_and_again_closes_its_bag(
        tmp_path, start: Starter, number):
    process = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "bag"}', '-p',
        'record.all_topics:=true')
    process.wait_for_output('/rosout')

    def ended() -> bool:
        if not process.alive():
            return True
        for each in (number, *NUMBERS):
            process.popen.send_signal(each)
        return False

    wait_until(ended, 'the end')
    assert process.popen.returncode == 0
    assert 'Traceback' not in process.stderr
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()
