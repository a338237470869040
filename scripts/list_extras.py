"""
Print what extras of the installed package require, one requirement a line.

    python scripts/list_extras.py test docs
"""

from importlib.metadata import requires
import sys


def main() -> None:
    """Print the requirements of the extras named on the command line."""
    for requirement in requires('hmsa_ros') or ():
        name, _, marker = requirement.partition(';')
        if any(f'extra == "{extra}"' in marker for extra in sys.argv[1:]):
            print(name.strip())


if __name__ == '__main__':
    main()
