"""Entry point of ``python -m hmsa_ros``, the same as the ``hmsa`` command."""

import signal
import sys

# An interrupt while modules are imported ends the process without a traceback.
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from hmsa_ros.cli import main  # noqa: E402

if __name__ == '__main__':
    sys.exit(main())
