"""
Run a command, and say every two seconds what it is doing and for how long.

    python scripts/narrate.py COMMAND ...

Each line contains the command's latest line of output. If the command fails, its last lines
follow.
"""

from collections import deque
from collections.abc import Sequence
import subprocess
import sys
import threading
import time

_PATIENCE = 2.0
_WIDTH = 76
_KEPT = 40


def main(words: Sequence[str], patience: float = _PATIENCE) -> int:
    """Run a command with a line after each ``patience`` s; return its exit status."""
    begun = time.monotonic()
    said = deque([' '.join(words)], maxlen=_KEPT)
    with subprocess.Popen(
            words, stdout=subprocess.PIPE, text=True, errors='replace') as process:
        output = process.stdout
        assert output is not None
        reader = threading.Thread(
            target=lambda: said.extend(filter(None, map(str.strip, output))), daemon=True)
        reader.start()
        while process.poll() is None:
            try:
                process.wait(patience)
            except subprocess.TimeoutExpired:
                seconds = time.monotonic() - begun
                print(f'  {said[-1][:_WIDTH]}, {seconds:.0f} s', flush=True)
        reader.join()
    if process.returncode:
        print(*said, sep='\n', file=sys.stderr)
    # As a shell does after a signal.
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


if __name__ == '__main__':
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
