"""The client of a planner: whom it waits for, verdicts of its own, the stop."""

from dataclasses import replace
import math
import re
import signal
import subprocess
import sys

import pytest
from trajectory_msgs.msg import JointTrajectory

from hmsa.cli import main, terminal
from hmsa.errors import HmsaError
from hmsa.model.units import NANOSECONDS
from hmsa_ros.clients.client import PlannerClient
from hmsa_ros.clients.link import Link, Stopping
from hmsa_ros.nodes.planner import PlannerNode

# Far ahead for a busy machine.
PLANNER = ('planner', '--ros-args', '-p', 'lead_time:=0.3')


@pytest.mark.ros
def test_another_subscriber_is_not_taken_for_the_planner(ros, ros_env, serve, wait_until):
    heard = []
    ros.node.create_subscription(JointTrajectory, 'planner/joint_trajectory', heard.append, 10)
    with PlannerClient() as client:
        client.spin_until(
            lambda: client._publisher.get_subscription_count() == 1, 'the other subscriber')
        assert not client.listened
        assert not client._reached()
        serve(PlannerNode)
        client.find_planner()
        assert client.listened
        assert client._publisher.get_subscription_count() == 2


@pytest.mark.ros
def test_each_of_many_requests_at_once_has_a_verdict_of_its_own(ros_env, serve):
    serve(PlannerNode)
    clients = [PlannerClient() for _ in range(6)]
    try:
        for client in clients:
            client.find_planner()
        # None of them reads its status before all have sent.
        names = [x.publish([(9.0 if i % 2 else 1.1 + 0.01 * i, 60.0)])
                 for i, x in enumerate(clients)]
        for i, (client, name) in enumerate(zip(clients, names, strict=True)):
            client.spin_until(
                lambda client=client, name=name: client.verdict.on(name) is not None, 'a verdict')
            assert client.verdict.on(name).code in (
                ('out_of_range',) if i % 2 else ('accepted', 'superseded'))
    finally:
        for client in clients:
            client.__exit__()


@pytest.mark.parametrize('words', [
    ['stop'], ['param', 'set', 'planner', 'shaper', 'robust'], ['send', '1.1:1'],
    ['watch', '--once']])
def test_a_command_without_a_planner_says_again_and_again_what_it_waits_for(
        words, ros_env, handlers, capfd, monkeypatch):
    monkeypatch.setattr(terminal, 'PATIENCE', 0.02)
    assert main([*words, '--timeout', '1']) == 1
    told = [x for x in capfd.readouterr().err.splitlines() if x.startswith('waiting up to 1 s')]
    assert re.search('planner|samples', told[0])
    assert len(told) > 1
    assert all(x.startswith(f'{told[0][:-4]}, ') for x in told[1:])


@pytest.mark.ros
def test_a_wait_without_a_limit_names_none(ros, ros_env, capfd, monkeypatch):
    monkeypatch.setattr(terminal, 'PATIENCE', 0.02)
    said = []
    with Link() as link:
        link.spin_until(
            lambda: said.append(capfd.readouterr().err) or 'rest' in said[-1], '',
            timeout=math.inf, awaited='rest')
    assert said[-1].startswith('waiting for rest ...')


@pytest.mark.ros
def test_a_stop_beside_another_client_is_sent_before_anything_else_is_known(
        ros, ros_env, serve, monkeypatch):
    node = serve(PlannerNode).nodes[0]
    requests = []
    monkeypatch.setattr(node._runtime, 'request', requests.append)
    with Link() as link:
        # The planner never answers, and its last status is on the request of another client.
        monkeypatch.setattr(link, 'timeout', 5.0)
        failure = link.try_to_stop()
    assert len(requests) > 1
    assert len({x.name for x in requests}) == 1
    assert 'the planner has not answered the stop' in failure


@pytest.mark.ros
def test_a_client_that_waits_in_vain_says_what_it_knows_and_how_to_stop_the_request(
        ros, ros_env, serve, monkeypatch):
    node = serve(PlannerNode, '-r', '__ns:=/a').nodes[0]
    request = node._runtime.request
    with PlannerClient(namespace='/a') as client:
        client.find_planner()
        known = 'which may still be carried out: stop it with hmsa stop --namespace /a; last'
        monkeypatch.setattr(node._runtime, 'request', lambda request: None)
        monkeypatch.setattr(client, 'timeout', 0.1)
        with pytest.raises(HmsaError) as caught:
            client.send_sequence([(1.1, 60.0)])
        assert str(caught.value) == (
            f'waited 0.1 s: the planner did not acknowledge the request, {known} status: idle, no '
            'request yet')
        monkeypatch.setattr(node._runtime, 'request', request)
        monkeypatch.setattr(client, 'timeout', 20.0)
        verdict = client.send_sequence([(1.1, 60.0)])
        client.spin_until(lambda: client.verdict.setpoint == 1, 'the move')
        with pytest.raises(HmsaError) as caught:
            client.follow(verdict, timeout=0.1)
        assert 'did not report the end of the sequence' in str(caught.value)
        assert f'{known} status: setpoint 1 of 1, ' in str(caught.value)


@pytest.mark.ros
def test_the_limit_of_a_wait_counts_from_the_start_of_the_sequence(
        ros_env, serve, monkeypatch):
    runtime = serve(PlannerNode).nodes[0]._runtime
    request = runtime.request
    monkeypatch.setattr(runtime, 'request', lambda asked: request(replace(
        asked, stamp=runtime.environment.clock() + 2 * NANOSECONDS)))
    with PlannerClient() as client:
        client.find_planner()
        verdict = client.send_sequence([(1.1, 60.0)])
        assert client.verdict.state == 'waiting'
        with pytest.raises(HmsaError, match='status: setpoint 1 of 1, '):
            client.follow(verdict, timeout=0.1)


@pytest.mark.ros
def test_a_second_planner_is_not_taken_for_a_newer_request(ros_env, serve, start):
    serve(PlannerNode)
    with PlannerClient() as client:
        client.find_planner()
        verdict = client.send_sequence([(1.1, 60.0)])
        start.hmsa(*PLANNER)
        with pytest.raises(HmsaError, match=(
                'ended early: the planner in namespace / was restarted, or a second one answers '
                r'\(no request yet\): expected one until the end')):
            client.follow(verdict, timeout=20.0)


@pytest.mark.ros
@pytest.mark.parametrize(('restarted', 'words'), [
    (True, r'the planner in namespace / was restarted, or a second one answers \(accepted'),
    (False, 'the planner in namespace / has ended: if an actuator moves, switch its coil off')])
def test_a_planner_that_ended_during_a_stop_is_named(start, restarted, words):
    # The stop itself begins far ahead.
    planner = ('planner', '--ros-args', '-p', 'lead_time:=60.0')
    first = start.hmsa(*planner)
    with Link() as link:
        stopping = Stopping(link)

        def told(what):
            stopping.go_on()
            return what()

        link.spin_until(lambda: told(lambda: stopping.answered), 'an answer')
        assert link.verdict.plan == 1
        first.stop()
        if restarted:
            # Its first plan has the number of the stop.
            start.hmsa(*planner)
            assert start.hmsa('send', '1.2:30').wait() == 0
        link.spin_until(lambda: told(lambda: stopping.failure), 'the end')
        assert re.match(f'the stop was sent, but {words}', stopping.failure)


@pytest.mark.slow
@pytest.mark.ros
def test_ctrl_c_of_a_sequence_that_is_waited_for_stops_it(start):
    start.hmsa('plant')
    start.hmsa(*PLANNER)
    send = start.hmsa('send', '1.1:60', '1.2:60', '--wait')
    send.wait_for_output('setpoint 1 of 2: holding')
    assert send.stop(signal.SIGINT) == 130
    assert 'stopped: at rest' in send.stderr


@pytest.mark.slow
@pytest.mark.ros
def test_a_stop_without_a_plant_fails_and_says_so(start):
    start.hmsa(*PLANNER)
    stop = start.hmsa('stop')
    assert stop.wait() == 1
    assert 'no node subscribes to' in stop.stderr


def test_the_stop_needs_no_numpy():
    code = "import sys, hmsa_ros.clients.link; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
