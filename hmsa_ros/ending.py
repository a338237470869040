"""
Ending on SIGINT and SIGTERM at a place that is safe to end at.

An exception raised by a signal handler can strike anywhere: in a callback that then fails
where it publishes, or between the start of a process and the note that it runs. Here the
handlers only remember, and the program looks.
"""

import signal


class Ending:
    """
    Whether a signal has asked the process to end.

    Attributes
    ----------
    asked : bool
        Set by SIGINT and SIGTERM from construction on.

    """

    def __init__(self) -> None:
        """Take the two signals over."""
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, *_: object) -> None:
        self.asked = True

    def check(self) -> None:
        """
        Raise KeyboardInterrupt if the end has been asked for.

        Raises
        ------
        KeyboardInterrupt
            At a place that the caller chose.

        """
        if self.asked:
            raise KeyboardInterrupt
