"""
Measure speed and accuracy.

    python -m benchmarks [NAME ...] [--quick] [--runs N] [--json FILE] [--page FILE]
    python -m benchmarks faults [--only KEY ...] [--quick] [--json FILE] [--page FILE]
    python -m benchmarks rates [--minutes M] [--quick]
    python -m benchmarks soak [--hours H] [--minutes M] [--factor F] [--rate HZ]
                             [--picture FILE] [--quick]

NAME is judge, planner, plant, preemption, joints, controller, recorder, player or crash; without
a name, all of these run. judge compares verdicts on simulated setpoints with the truth.
recorder, player and crash take about seven minutes together. The others run only on request:
faults injects faults into running nodes and fails if the response to one is not as expected.
soak runs for hours. feedback moves actuators that differ from the planner's model, in real time,
for about three minutes. identification fits thousands of simulated runs; defects fits those of
actuators that deviate from the model. harm compares feedback with open loop in random
laboratories, for half an hour. laboratory tunes laboratories behind a serial board, for a quarter
of an hour; line makes cables, boards, amplifiers and sensors fail there, for two minutes. rates
measures how many plans per second studies compute, for about seven minutes. lockstep compares the
kernel of batches with C. continuum plays commands on finite elements, for eight minutes;
compressible compares a compressible block with them, for three; predictions compares what plans
predict there, for two; waves measures the amplitude of waves there, for five; continuum-feedback
moves blocks there with feedback, for five; beam plays commands on an exact rod, for three;
beam-identification identifies recordings of this rod, for five.
repeats plays what `hmsa learn` makes of repeats on finite elements and an exact rod, for half an
hour.
modes identifies secondary modes from recordings of these elements, for half an hour. adapting
moves up to 64 joints with feedback, in a minute.
A page is a Markdown file; a table replaces the text between its marks ``<!-- begin NAME -->`` and
``<!-- end NAME -->``.
"""

import argparse
import importlib
import importlib.util
import inspect
import json
from pathlib import Path
import sys
from typing import Any

from rich.console import Console

from benchmarks.measure import machine
from benchmarks.sheet import Sheet

# Of a table that is written to a file.
_WIDTH = 120

#: Benchmarks, each with the functions that make its tables, as MODULE.FUNCTION of bench_MODULE,
#: which take some of the options.
TABLES = {
    'judge': ('judge.compare',),
    'planner': ('planner.compare', 'planner.choices', 'planner.start_up'),
    'plant': ('plant.compare',), 'preemption': ('preemption.compare',),
    'joints': ('joints.compare',), 'controller': ('controller.compare',),
    'recorder': ('recorder.compare',), 'player': ('player.compare',), 'crash': ('crash.compare',)}
NAMES = tuple(TABLES)
#: The others run on request only: they take long and need the machine for themselves.
TABLES |= {
    'faults': ('faults.compare',), 'soak': ('soak.compare',), 'feedback': ('feedback.compare',),
    'identification': (
        'identification.speed', 'identification.robustness', 'identification.compare'),
    'defects': ('defects.compare',), 'harm': ('harm.compare',),
    'laboratory': ('laboratory.compare',), 'line': ('line.compare',),
    'rates': ('studies.rates',),
    'lockstep': ('studies.lockstep',),
    'continuum': ('continuum.compare', 'continuum.little_damped', 'continuum.glued'),
    'compressible': ('compressible.compare',), 'predictions': ('continuum.predicted',),
    'waves': ('continuum.waves',), 'continuum-feedback': ('continuum.followed',),
    'repeats': ('repeats.compare',), 'beam': ('beam.compare', 'beam.sequences'),
    'beam-identification': ('beam.identified',),
    'modes': ('continuum.covered', 'continuum.identified'), 'adapting': ('joints.adapting',)}
LONG = tuple(TABLES)[len(NAMES):]
_NEED_ROS = ('preemption', 'joints', 'controller', 'recorder', 'player', 'crash', 'feedback',
             'faults', 'soak', 'adapting')


def main(arguments: list[str] | None = None) -> int:
    """Run benchmarks and print their tables."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks', description='Measure speed and accuracy.')
    parser.add_argument('names', nargs='*', metavar='NAME',
                        help=f'{", ".join(NAMES)}; default all of these; or '
                             f'{", ".join(LONG)}')
    parser.add_argument('--quick', action='store_true',
                        help='little of everything: shows that it runs, not how fast')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all figures to a file')
    parser.add_argument('--page', type=Path, metavar='FILE',
                        help='renew the tables of a page of the documentation')
    parser.add_argument('--only', action='append', default=[], metavar='KEY',
                        help='faults: beginning of the key of a fault to inject')
    parser.add_argument('--runs', type=int, default=None,
                        help='harm: laboratories (default 400); laboratory, line: of each kind '
                             '(default 20); beam: random sequences (default 4); '
                             'beam-identification: recordings of each kind (default 4); '
                             'identification, '
                             'judge, defects: simulated runs of each kind '
                             '(default 200, defects 30), in identification at most 40 of those')
    parser.add_argument('--hours', type=float, default=8.0,
                        help='soak: simulated time (default 8)')
    parser.add_argument('--minutes', type=float, default=float('inf'),
                        help='soak: time on the wall, at most; rates: roughly, of all')
    parser.add_argument('--factor', type=float, default=None,
                        help='soak: real-time factor asked for, 0 for as fast as it can')
    parser.add_argument('--rate', type=float, default=1000.0,
                        help='soak: sample rate of the plant in Hz (default 1000)')
    parser.add_argument('--picture', type=Path, metavar='FILE',
                        help='soak: PNG of memory over time; harm: of what feedback leaves more')
    options = parser.parse_args(arguments)
    if options.page and not options.page.is_file():
        parser.error(f'--page: there is no file {options.page}: expected a page with marks')
    names = options.names or NAMES
    for name in names:
        if name not in NAMES + LONG:
            parser.error(
                f'there is no benchmark {name!r}: expected {", ".join(NAMES + LONG)}')
    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    host = machine()
    where = (f'{host["processor"]}, {host["cores"]} cores, Python {host["python"]}, '
             f'SciPy {host["scipy"]}; load average {host["load_average"]:.1f} '
             'at the start')
    console.print(where)
    if host['load_average'] > 0.5:
        console.print('Other processes are running: trust the ratios, least times above all.')
    sheets: list[Sheet] = []
    record: dict[str, Any] = {'machine': host}
    status = 0
    options.runs = options.runs or None
    given = {x: y for x, y in vars(options).items() if y is not None}
    names = [x for x in names if x not in _NEED_ROS or _has_ros(x)]
    for path in (y for x in TABLES if x in names for y in TABLES[x]):
        module, _, function = path.partition('.')
        make = getattr(importlib.import_module(f'benchmarks.bench_{module}'), function)
        takes = inspect.signature(make).parameters
        sheet: Sheet = make(**{x: y for x, y in given.items() if x in takes})
        sheet.show(console)
        sheets.append(sheet)
        record[sheet.key] = sheet.record()
        if not sheet.passed:
            console.print(f'{sheet.key}: not what is promised')
            status = 1
    if options.json:
        options.json.write_text(
            json.dumps(record, indent=2, default=str) + '\n', encoding='utf-8')
    if options.page:
        texts = {x.key: x.markdown() for x in sheets}
        if remarks := [y for x in sheets for y in x.remarks]:
            texts['machine'] = '\n'.join([where + '.', '', *(f'* {x}' for x in remarks)])
        page = renewed(options.page.read_text(encoding='utf-8'), texts)
        options.page.write_text(page, encoding='utf-8')
    return status


def renewed(page: str, texts: dict[str, str]) -> str:
    """Replace the text between the marks of a page."""
    for name, text in texts.items():
        begin, end = f'<!-- begin {name} -->', f'<!-- end {name} -->'
        head, mark, rest = page.partition(begin)
        _, last, tail = rest.partition(end)
        if mark and last:
            page = f'{head}{begin}\n\n{text.strip()}\n\n{end}{tail}'
    return page


def _has_ros(name: str) -> bool:
    """Return whether ROS 2 is installed; print a line if it is not."""
    if importlib.util.find_spec('rclpy') is None:
        print(f'{name}: ROS 2 (rclpy) is not installed')
        return False
    return True


if __name__ == '__main__':
    sys.exit(main())
