"""Work in a process beside the planner: same results, even if either process ends."""

from dataclasses import replace
import os
import select
import signal
import subprocess
import sys

from bench_oracle import Bench, Plant
import numpy as np
import pytest

from hmsa.model.parameters import paper_actuator
from hmsa.offload import at_once, finish, goes_on, here, is_ready, Offload

MS = 1_000_000


def whose(value, gate=None):
    """Return a value, once a pipe has data, and the process that returned it."""
    if gate is not None:
        gate.read_text()
    return value, os.getpid()


def ends(parent):
    """End the present process unless it is the parent."""
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return 'here'


@pytest.fixture
def offload():
    told = []
    # Imported while the process starts, which may take long on a busy machine.
    found = Offload(told.append, 'test_offload')
    found.told = told
    yield found
    found.close()


def test_each_gets_the_answer_to_what_it_asked_in_whatever_order_they_look(offload, tmp_path):
    gate = tmp_path / 'gate'
    os.mkfifo(gate)
    finish(offload(whose, 'ready'))
    first, second = offload(whose, 1, gate), offload(whose, 2)
    assert goes_on(first)
    assert goes_on(second)
    gate.write_text('')
    # Nobody looks for the first while the second waits.
    (two, there), (one, _) = finish(second), finish(first)
    assert (one, two) == (1, 2)
    assert there != os.getpid()
    left = offload(whose, 'left', gate)
    assert goes_on(left)
    left.close()
    gate.write_text('')
    assert finish(offload(whose, 3)) == (3, there)
    assert not offload.told


def test_it_is_ready_once_its_process_has_started_or_cannot(offload, wait_until, monkeypatch):
    assert is_ready(here)
    offload.start()
    assert not is_ready(offload)
    wait_until(lambda: is_ready(offload), 'the process')
    assert not offload.told
    offload.close()
    # One that ends while it starts, and one that takes too long.
    for end, start in ((True, 60_000_000_000), (False, -1)):
        monkeypatch.setattr('hmsa.offload._START', start)
        broken = Offload(offload.told.append, 'test_offload')
        broken.start()
        if end:
            broken._workers[0]._process.kill()
        wait_until(lambda broken=broken: is_ready(broken), 'the end of the wait')
        assert 'has ended, does not answer, or cannot start' in offload.told.pop()
        broken.close()


def test_two_processes_work_at_once_and_as_many_as_there_are_cores(tmp_path, monkeypatch):
    monkeypatch.setattr('os.sched_getaffinity', lambda _: range(2))
    offload, gate = Offload(print, 'test_offload', 3), tmp_path / 'gate'
    os.mkfifo(gate)
    try:
        finish(offload(whose, 'ready'))
        first = offload(whose, 1, gate)
        # The second is done while the first waits for its gate.
        assert goes_on(first)
        (two, there) = finish(offload(whose, 2))
        assert goes_on(first)
        gate.write_text('')
        (one, other) = finish(first)
        assert (one, two) == (1, 2)
        assert other != there
        assert at_once(offload) == 2
    finally:
        offload.close()


def test_a_process_that_ends_is_done_without_and_said_once(offload):
    assert finish(offload(ends, os.getpid())) == 'here'
    assert finish(offload(whose, 3)) == (3, os.getpid())
    words, = offload.told
    assert 'the planner estimates itself' in words


def test_a_process_that_does_not_answer_is_done_without(offload, monkeypatch):
    _, process = finish(offload(whose, 1))
    assert process != os.getpid()
    os.kill(process, signal.SIGSTOP)
    monkeypatch.setattr('hmsa.offload._PATIENCE', 0)
    assert finish(offload(whose, 2)) == (2, os.getpid())
    assert 'does not answer' in offload.told[0]


def test_it_ends_with_the_planner_however_that_ends_and_not_by_ctrl_c(tmp_path):
    script = tmp_path / 'planner.py'
    script.write_text(
        'import time\n'
        'from hmsa.offload import finish, Offload\n'
        'from test_offload import whose\n'
        'offload = Offload(print, "test_offload")\n'
        'print(finish(offload(whose, 1))[1], flush=True)\n'
        'time.sleep(600)\n')
    with subprocess.Popen(
            [sys.executable, script], stdout=subprocess.PIPE, text=True,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}) as planner:
        try:
            process = os.pidfd_open(int(planner.stdout.readline()))
            signal.pidfd_send_signal(process, signal.SIGINT)
            end = select.poll()
            end.register(process)
            assert not end.poll(500)
        finally:
            planner.kill()
    assert end.poll(60_000)


def test_what_is_learnt_is_the_same_in_either_process(offload):
    sent = {}
    for name, doing in (('here', here), ('offload', offload)):
        def waited_for(work, *arguments, doing=doing):
            return finish(doing(work, *arguments))
            yield

        block = paper_actuator()
        stiffer = replace(block, shear_modulus=1.1 * block.shear_modulus)
        bench = Bench(Plant(stiffer), block, 1e-3, seed=1)
        bench.runtime.follower.doing = waited_for
        for target in (1.3, 1.1, 1.25):
            bench.move(target, 200 * MS)
        assert 'plans use it' in bench.message
        sent[name] = np.array(bench.sent)
    assert np.array_equal(sent['here'], sent['offload'])
