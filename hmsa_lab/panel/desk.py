"""The panel's access to ROS, in one thread that never blocks; its recordings and interlock."""

from collections.abc import Callable, Mapping, Sequence
import json
import math
from pathlib import Path
from queue import Empty
import subprocess
import sys
import threading
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from std_msgs.msg import Bool

from hmsa.ending import ENDING
from hmsa.errors import BadInputError, HmsaError, printable
from hmsa.files import finite
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import real, texts
from hmsa.interfaces.topics import DRIVER, INTERLOCK, RECORDER
from hmsa_lab.panel.listener import as_json, LEVELS, Listener, PeakHistory, Scene, SLOTS
from hmsa_lab.panel.server import Server
from hmsa_ros.clients.client import PlannerClient
from hmsa_ros.clients.experiment import Experiment, prepare, recorder_of
from hmsa_ros.clients.link import Stopping
from hmsa_ros.clients.processes import dated, Session
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.temporary_node import ServiceCall
from hmsa_ros.runtime.records import FEEDBACK_MODES as MODES

# Interval of repeats in s, well within the default interlock_timeout of a driver.
_REPEAT_SECONDS = 0.1

# Frame interval in s; number of chart slots in a frame; time in s for which a new page gets all.
_PERIOD, _TAIL, _NEW_SECONDS = 0.02, 24, 1.0
# Time in s for a page to be reloaded, and after which a planner counts as gone.
_RELOAD_SECONDS, _GONE_SECONDS = 1.0, 10.0
_ASK_SECONDS = 1.0
_RESTING = ('at_rest', 'idle')
_WARN = 1


class InterlockSwitch:
    """
    Open and close the interlock of a driver, once asked to.

    A message is repeated while the panel runs. An opening outlasts the panel: a driver keeps its
    interlock open until another publisher closes it.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._publisher = node, ros_entities.publisher(node, INTERLOCK, DRIVER)
        self.closed: bool | None = None  #: as last requested; None before the first request
        self._next = math.inf

    @property
    def present(self) -> bool:
        """Whether a driver listens."""
        return ros_entities.heard(self._node, self._publisher)

    def turn(self, now: float, *, closed: bool) -> None:
        """Open or close it, from a time in s on."""
        self.closed, self._next = closed, now
        self.repeat(now)

    def repeat(self, now: float) -> None:
        """Repeat the last message when it is time."""
        if self.closed is not None and now >= self._next:
            self._publisher.publish(Bool(data=self.closed))
            self._next = now + _REPEAT_SECONDS


class PanelRecorder:
    """
    Record to new folders in ``base``, in a separate process; another one makes the report.

    ``state`` is off, on, closing or reporting; ``trouble`` contains the last error.
    """

    def __init__(self, base: Path, namespace: str, joints: tuple[str, ...]) -> None:
        self._base, self._namespace, self._joints = base, namespace, joints
        self.state = 'off'
        self.trouble = ''
        self.bag: Path | None = None
        self.since = 0.0
        self.report: Path | None = None
        self._session: Session | None = None
        self._worker: threading.Thread | None = None
        self._ending = False

    def start(self, simulated: bool) -> None:
        """Start, in simulated time if ``simulated``; raise `HmsaError` if that is impossible."""
        if self.state != 'off':
            raise HmsaError(f'the recording is {self.state}: expected none')
        folder = dated(self._base).resolve()
        prepare(folder)
        experiment = Experiment(
            folder, (), namespace=self._namespace, joints=self._joints)
        self._session = Session(folder)
        self._session.start(recorder_of(experiment, simulated))
        self.state, self.bag, self.since = 'on', experiment.bag, monotonic()
        self.trouble, self.report = '', None

    def check(self) -> None:
        """Detect an early end of the recorder."""
        try:
            if self.state == 'on' and self._session is not None:
                self._session.check()
        except HmsaError as error:
            self.state, self.trouble = 'off', str(error)

    def stop(self) -> None:
        """Close the bag and make its report, without waiting."""
        if self.state == 'on' and self._session is not None and self.bag is not None:
            self.state = 'closing'
            self._worker = threading.Thread(
                target=self._finish, args=(self._session, self.bag), daemon=True)
            self._worker.start()

    def close(self) -> None:
        """Close an open bag and wait for that, but not for a report."""
        self._ending = True
        self.stop()
        while self._worker is not None and self.state == 'closing':
            self._worker.join(0.1)

    def _finish(self, session: Session, bag: Path) -> None:
        if session.stop()[RECORDER]:
            self.trouble = f'the recorder failed: {session.last_words(RECORDER)}'
        elif not self._ending:
            self.state = 'reporting'
            page = bag.parent / 'report.html'
            done = subprocess.run(
                [sys.executable, '-m', 'hmsa_ros', 'report', bag, '--out', page],
                capture_output=True, text=True, errors='replace', start_new_session=True,
                check=False)
            if done.returncode:
                self.trouble = ' '.join(done.stderr.split()[-60:]) or 'the report failed'
            else:
                self.report = page
        self.state = 'off'


class Desk:
    """
    Carry out the commands of a server's pages, and send them the present state.

    Parameters
    ----------
    server : Server
        Server of the page.
    parse : callable
        Returns one setpoint from its text.
    out : Path
        Folder of recordings.
    namespace, joints : str, tuple of str
        Planner and joints to operate.
    span : float
        Duration of the charts in s.
    stop_on_close : bool
        Whether to come to rest when the last page is closed.

    """

    def __init__(
            self, server: Server, parse: Callable[[str], tuple[Sequence[float], float]], out: Path,
            namespace: str, joints: tuple[str, ...], span: float, *, stop_on_close: bool) -> None:
        self._server, self._parse, self._joints, self._span = server, parse, joints, span
        self._stop_on_close = stop_on_close
        self._client = PlannerClient(namespace=namespace, joints=joints)
        self._listener = Listener(namespace=namespace, joints=joints, span=span)
        node = self._client.node
        self._stopping: Stopping | None = None
        self._get = ServiceCall(
            node, GetParameters, f'{topics.PLANNER}/get_parameters',
            GetParameters.Request(names=['feedback', 'use_sim_time']))
        self._set: ServiceCall | None = None
        ros_entities.subscribe(node, topics.ESTIMATE, self._on_estimate, topics.PLANNER)
        self._interlock = InterlockSwitch(node)
        self._recording = PanelRecorder(out, namespace, joints)
        self._estimates: dict[str, dict[str, Any]] = {}
        self._known: Mapping[str, Any] = {}
        self._next_ask = 0.0
        # The last request, its time, and whether the planner has received it or never will.
        self._request, self._sent, self._received = '', -math.inf, True
        self._plan: int | None = None  # number of its plan, if it was accepted
        self._pages, self._news, self._left = 0, -math.inf, math.inf
        self._note: dict[str, Any] = {'number': 0, 'level': 'OK', 'text': ''}

    def run(self) -> None:
        """Serve until the end is requested; then stop the actuator and close the bag."""
        try:
            while not ENDING.asked:
                self._client.pass_time(_PERIOD)
                self._step()
        except KeyboardInterrupt:
            pass
        finally:
            if self._stop_on_close and self._moves and (
                    failure := self._client.try_to_stop()):
                print(f'hmsa: note: {failure}', file=sys.stderr, flush=True)
            self._recording.close()
            self._listener.__exit__()
            self._client.__exit__()

    def _step(self) -> None:
        scene, now = self._listener.look(), monotonic()
        if not self._received and (answer := self._client.verdict.on(self._request)) is not None:
            self._received, self._plan = True, answer.plan
            if answer.level > _WARN:
                self._plan = None
        if not self._received:
            self._client.send_again()
        if not self._received and now - self._sent > _GONE_SECONDS:
            self._received = True
            self._notify(
                'the planner did not acknowledge the request, which may still be carried out: '
                'stop it, or send it again', 2)
        self._look_at_pages(now)
        if self._server.coil_off.is_set():
            self._server.coil_off.clear()
            self._open_interlock(now)
        self._interlock.repeat(now)
        if self._server.stop.is_set():
            self._server.stop.clear()
            self._begin_stop()
        self._follow_stop()
        try:
            while True:
                self._carry_out(self._server.commands.get_nowait(), now)
        except Empty:
            pass
        self._follow_rest(now)
        # No outdated frame for a page that opens later.
        self._server.frame = json.dumps(
            finite(self._frame(scene, now)), separators=(',', ':')) if self._pages else ''

    def _notify(self, text: str, level: int = 0) -> None:
        self._note = {
            'number': self._note['number'] + 1, 'level': LEVELS[level], 'text': printable(text)}

    @property
    def _moves(self) -> bool:
        """Whether a request of the panel is being carried out, as far as known."""
        verdict = self._client.verdict
        return not self._received or (
            verdict.plan == self._plan and verdict.state not in _RESTING)

    def _look_at_pages(self, now: float) -> None:
        """Detect new pages, and that the last one was closed."""
        pages = len(self._server.pages)
        if pages > self._pages:
            self._news = now
        if pages:
            self._left = math.inf
        elif self._pages:
            self._left = now
        self._pages = pages
        if now - self._left > _RELOAD_SECONDS:
            self._left = math.inf
            if self._stop_on_close and self._moves:
                self._begin_stop()

    # -- stop ----------------------------------------------------------------------------------

    def _begin_stop(self) -> None:
        self._stopping = Stopping(self._client)
        self._notify('stopping', 1)

    def _follow_stop(self) -> None:
        """Report the result of a stop."""
        if self._stopping is None:
            return
        self._stopping.go_on()
        if self._stopping.done is not None or self._stopping.failure is not None:
            self._notify(self._stopping.words, 0 if self._stopping.done is not None else 2)
            self._stopping = None

    def _open_interlock(self, now: float) -> None:
        """Have the driver switch the coil off; its status says when."""
        self._interlock.turn(now, closed=False)
        self._notify(*(
            ('interlock opened: the driver switches the coil off and keeps it off until the '
             'interlock is closed', 1) if self._interlock.present else
            ('no driver listens to the interlock: switch the amplifier off', 2)))

    # -- commands ------------------------------------------------------------------------------

    def _carry_out(self, command: Mapping[str, Any], now: float) -> None:
        try:
            match command:
                case {'do': 'send', 'setpoints': str(words)}:
                    self._send(words, now)
                case {'do': 'feedback', 'mode': str(mode)} if mode in MODES:
                    self._set_feedback(mode)
                case {'do': 'close_interlock'}:
                    self._interlock.turn(now, closed=True)
                    self._notify('interlock closed by the panel: send a new request')
                case {'do': 'record', 'on': True}:
                    self._recording.start(bool(self._known.get('use_sim_time')))
                    self._notify('recording')
                case {'do': 'record', 'on': False}:
                    self._recording.stop()
                case _:
                    raise BadInputError(
                        f'unknown command {str(command.get("do"))[:40]!r}: reload the page')
        except HmsaError as error:
            self._notify(str(error), 2)

    def _send(self, words: str, now: float) -> None:
        if self._stopping is not None and not self._stopping.answered:
            raise HmsaError('not sent, since the actuator is being stopped: send it again')
        setpoints = [self._parse(x) for x in words.split()]
        if not setpoints:
            raise BadInputError('no setpoint: expected STRETCH:SECONDS ..., such as 1.10:1 1.00:1')
        if not self._client.listened:
            raise HmsaError('no planner listens: start one with hmsa planner')
        self._request, self._sent, self._received = self._client.publish(setpoints), now, False
        # What a stop has come to does not matter any more.
        self._stopping = None
        self._notify(f'sent {" ".join(words.split())}')

    def _set_feedback(self, mode: str) -> None:
        if self._set is not None:
            self._set.close()
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=mode)
        self._set = ServiceCall(
            self._client.node, SetParameters, f'{topics.PLANNER}/set_parameters',
            SetParameters.Request(parameters=[Parameter(name='feedback', value=value)]))

    def _follow_rest(self, now: float) -> None:
        """Process responses of the parameter services, and check the recorder."""
        if self._set is not None and (answer := self._set.answer()) is not None:
            self._set.close()
            self._set, self._next_ask = None, 0.0
            for result in answer.results[:1]:
                if not result.successful:
                    self._notify(f'the planner refused: {result.reason}', 2)
        if not (self._get.ready and self._client.listened):
            self._known = {}
        elif now >= self._next_ask and (answer := self._get.answer()) is not None:
            self._known = dict(zip(('feedback', 'use_sim_time'), map(
                parameter_value_to_python, answer.values), strict=False))
            self._next_ask = now + _ASK_SECONDS
        self._recording.check()
        if self._recording.trouble:
            self._notify(self._recording.trouble, 2)
            self._recording.trouble = ''

    def _on_estimate(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = texts(status)
            # For one joint or several, whose names are known.
            if status.hardware_id in self._joints:
                self._estimates[status.hardware_id] = {
                    'joint': status.hardware_id, 'level': LEVELS[min(status.level[0], 3)],
                    'message': printable(status.message), 'rows': [
                        [name, *(real(values.get(f'{name}{end}'))
                                 for end in ('', '.std', '.nominal'))]
                        for name in values if f'{name}.std' in values]}

    # -- frames --------------------------------------------------------------------------------

    def _frame(self, scene: Scene, now: float) -> dict[str, Any]:
        """Return the contents of a page, for JSON."""
        recording, feedback = self._recording, self._known.get('feedback', '')
        reports = self._server.reports
        if recording.report is not None:
            reports[recording.report.parent.name] = recording.report
        tail = SLOTS if now - self._news < _NEW_SECONDS else _TAIL
        seen = as_json(scene)
        if scene.request is not None:
            # The finding in words, since figures come from an untrusted message.
            seen['request']['finding'] = scene.request.finding
        return {
            **seen,
            'slot': math.floor(scene.now / (self._span / SLOTS)),
            'span': self._span, 'slots': SLOTS, 'charts': {
                x.name: {
                    'coordinate': x.coordinate,
                    'stretch': _tail(x.stretches, scene.now, tail),
                    'target': _tail(x.targets, scene.now, tail),
                    'flux': _tail(x.fluxes, scene.now, tail)} for x in scene.joints},
            'feedback': feedback, 'modes': MODES, 'setting': self._set is not None,
            'estimates': list(self._estimates.values()) if feedback not in ('', 'off') else [],
            'recording': {
                'state': recording.state, 'bag': str(recording.bag or ''),
                'seconds': now - recording.since if recording.state == 'on' else None,
                'reports': list(reports)},
            'stopping': self._stopping is not None, 'note': self._note,
            'interlock': {'present': self._interlock.present, 'closed': self._interlock.closed}}


def _tail(history: PeakHistory, now: float, count: int) -> list[list[float]]:
    """Return minima and maxima in the last slots of a history."""
    return [np.round(side[-count:], 7).tolist() for side in history.ranges(now)]
