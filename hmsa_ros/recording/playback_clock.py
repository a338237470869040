"""Position and speed of playback, controlled by other threads: pause, seek, step and stop."""

from collections import deque
import threading
import time

# An interruptible wait ends this much early; sleeping the rest is more accurate.
_FINE_SECONDS = 0.01


class PlayingInterruptedError(Exception):
    """Playback was stopped, or is to continue from another time of the bag."""


class PlaybackClock:
    """
    The schedule of one playback, initially paused: when each time of the bag (ns) is due.

    ``rate`` multiplies the recorded speed, ``position`` is the current time of the bag and
    ``late`` the largest delay of a message so far in s. Every change notifies ``change``.
    """

    def __init__(self, start: int, rate: float) -> None:
        self.change = threading.Condition()
        self.paused = True
        self.stopped = False
        self.rate = rate
        self.position = start
        self.late = 0.0
        self._seek: int | None = None
        self._steps = 0
        self._answers: deque[threading.Event] = deque()
        self._anchor = (start, time.monotonic())

    # Called by other threads -------------------------------------------------------------------

    def set_paused(self, paused: bool) -> None:
        """Pause or resume, without a jump in the schedule."""
        with self.change:
            if paused != self.paused:
                self._rebase()
                self.paused = paused
                self.change.notify_all()

    def set_rate(self, rate: float) -> None:
        """Change the speed, without a jump in the schedule."""
        with self.change:
            self._rebase()
            self.rate = rate
            self.change.notify_all()

    def seek(self, when: int) -> None:
        """Continue from a time of the bag in ns."""
        with self.change:
            self._seek = when
            self.change.notify_all()

    def step(self, timeout: float) -> bool:
        """Send one message while paused; return whether there was one within ``timeout`` s."""
        answer = threading.Event()
        with self.change:
            self._steps += 1
            self._answers.append(answer)
            self.change.notify_all()
        answer.wait(timeout)
        with self.change:
            if self._steps and not answer.is_set():
                # Withdraw the step, so that it does not send a message later.
                self._steps -= 1
                self._answers.remove(answer)
        return answer.is_set() and not self.stopped

    def stop(self) -> None:
        """Stop playback, and end all waits for it."""
        with self.change:
            self.stopped = True
            for answer in self._answers:
                answer.set()
            self.change.notify_all()

    def _rebase(self) -> None:
        """Restart the schedule at the current time and position."""
        since, began = self._anchor
        now = time.monotonic()
        if not self.paused:
            since += round((now - began) * 1e9 * self.rate)
        self._anchor = (since, now)

    # Called by the thread that sends -----------------------------------------------------------

    def begin(self, start: int) -> None:
        """Start the schedule: a time of the bag is due now."""
        with self.change:
            self.position = start
            self._anchor = (start, time.monotonic())

    @property
    def interrupted(self) -> bool:
        """Return whether playback is to stop or to seek."""
        return self.stopped or self._seek is not None

    def take_seek(self, otherwise: int) -> int:
        """Return the time of the bag to continue from."""
        with self.change:
            start, self._seek = self._seek, None
            return otherwise if start is None else start

    @property
    def stepping(self) -> bool:
        """Whether the next message is to be sent immediately."""
        return self._steps > 0

    def sent(self, when: int) -> None:
        """Record that a message was sent, and complete the step that requested it."""
        self.position = when
        if self._answers:
            with self.change:
                # A step may have been withdrawn in between.
                if self._answers:
                    self._answers.popleft().set()

    def rest(self, seconds: float) -> bool:
        """Wait for a time in s; return whether playback was stopped meanwhile."""
        with self.change:
            return self.change.wait_for(lambda: self.stopped, max(0.0, seconds))

    def wait(self, when: int, *, message: bool, timeout: float) -> int | None:
        """
        Wait until a time of the bag (ns) is due; a message can be requested by a step.

        Returns None then, or the current time of the bag after ``timeout`` s of a pause. Raises
        `PlayingInterruptedError`.
        """
        while True:
            with self.change:
                if self.interrupted:
                    raise PlayingInterruptedError
                since, began = self._anchor
                if self.paused:
                    if self._steps:
                        if message:
                            self._steps -= 1
                            self._anchor = (when, time.monotonic())
                        return None
                    if not self.change.wait(timeout):
                        return since
                    continue
                delay = began + (when - since) * 1e-9 / self.rate - time.monotonic()
                if delay > 2 * _FINE_SECONDS:
                    self.change.wait(delay - _FINE_SECONDS)
                    continue
            if delay > 0.0:
                time.sleep(delay)
            else:
                self.late = max(self.late, -delay)
            return None
