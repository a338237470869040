"""A recording that can be switched on and off, and its report."""

from pathlib import Path
import subprocess
import sys
import threading
from time import monotonic

from hmsa.errors import HmsaError
from hmsa.interfaces.topics import RECORDER
from hmsa_ros.clients.experiment import Experiment, prepare, recorder_of
from hmsa_ros.clients.processes import dated, Session


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
