"""
Test a hardware class at small levels.

Test a hardware class as hmsa driver uses it, without ROS, with flux densities up to --limit:
levels, their timing, samples, polarity, and whether the coil is off after a silence, close, an
exception and SIGTERM. Takes about ten seconds. The exit status is 0 if all checks pass.

example: hmsa check-driver my_lab:Coil --set port=/dev/ttyACM0
"""

import argparse
from pathlib import Path
import sys
from typing import Any

from hmsa.cli.options import add_command, frequency, JSON, Row, show
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError
from hmsa.files import check_targets, write_text

#: Settings of a hardware class, read by `settings_of`.
SETTINGS: Row = (
    '--set', 'KEY=VALUE', str, 'a setting of the hardware, as hardware.KEY of hmsa driver; may be '
    'given several times', {'action': 'append', 'default': []})


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('hardware', 'MODULE:NAME', str,
         'as in the parameter hardware of hmsa driver, such as serial_board'),
        ('--joint', 'NAME', str, 'name of the joint (default actuator)', {'default': 'actuator'}),
        SETTINGS,
        ('--limit', 'T', float, 'maximum flux density (default 0.001 T)',
         {'default': 1e-3}),
        frequency('--rate', 'sample rate (default 200 Hz)', default=200.0),
        ('--report', 'HTML', Path, 'page with the checks and histograms of times'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """
    Test the hardware, and print the results.

    Raises
    ------
    BadInputError
        If the folder of the page does not exist, or a setting is invalid.

    """
    check_targets(arguments.report)
    settings = settings_of(arguments)
    with progress(f'loading {arguments.hardware}') as update:
        from hmsa_lab.bench.conformance import ConformanceTrial

        found = ConformanceTrial(
            arguments.hardware, arguments.joint, settings, level=arguments.limit,
            rate=arguments.rate).run(update)
    if arguments.report is not None:
        from hmsa_lab.bench.report import page

        write_text(arguments.report, page(found))
    show(
        arguments, found.as_json(),
        *(f'{"ok" if x.passed else "FAILED":<7}{x.name:<18}{x.sentence}' for x in found.checks),
        *(f'-      not tried: {x}' for x in found.untried), written=[arguments.report])
    failed = [x.name for x in found.checks if not x.passed]
    if not arguments.json:
        print(f'{found.name}: ' + (
            f'{len(failed)} of {len(found.checks)} checks failed: {", ".join(failed)}' if failed
            else f'{len(found.checks)} checks passed'), file=sys.stderr)
    return 0 if found.passed else 1


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return keyword arguments with YAML values; raise `BadInputError` if one is invalid."""
    import yaml

    found = {}
    for text in arguments.set:
        key, given, value = text.partition('=')
        if not given or not all(x.isidentifier() for x in key.split('.')):
            raise BadInputError(f'--set {text}: expected KEY=VALUE, as in --set port=/dev/ttyACM0')
        try:
            found[key] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise BadInputError(f'--set {text}: expected a value as in YAML') from error
    return found
