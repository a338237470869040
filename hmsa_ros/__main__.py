"""Entry point of ``python -m hmsa_ros``, the same as the ``hmsa`` command."""

import sys

from hmsa.entry import main

if __name__ == '__main__':
    sys.exit(main())
