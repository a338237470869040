"""
Measure speed and accuracy.

    python -m benchmarks [NAME ...] [--quick] [--json FILE] [--page FILE]

NAME is planner, plant, preemption or recorder; without one all are run. The recorder's takes
some minutes.
A page is a Markdown file with marks ``<!-- begin NAME -->`` and ``<!-- end NAME -->``, between
which a table is put.
"""

import argparse
import importlib.util
import json
from pathlib import Path
import sys
import tempfile
from typing import Any

from rich.console import Console

from benchmarks.measure import machine, Report

# Of a table that goes to a file.
_WIDTH = 120

NAMES = ('planner', 'plant', 'preemption', 'recorder')


def main(arguments: list[str] | None = None) -> int:
    """
    Run benchmarks and print their tables.

    Parameters
    ----------
    arguments : list of str, optional
        Default those of the command line.

    Returns
    -------
    int
        Exit status: 0, or that of the recorder's benchmark.

    """
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks', description='Measure speed and accuracy.')
    parser.add_argument('names', nargs='*', metavar='NAME',
                        help=f'{", ".join(NAMES)}; default all')
    parser.add_argument('--quick', action='store_true',
                        help='little of everything: shows that it runs, not how fast')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all figures to a file')
    parser.add_argument('--page', type=Path, metavar='FILE',
                        help='renew the tables of a page of the documentation')
    options = parser.parse_args(arguments)
    names = options.names or NAMES
    for name in names:
        if name not in NAMES:
            parser.error(f'there is no benchmark {name!r}: expected {", ".join(NAMES)}')
    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    host = machine()
    where = (f'{host["processor"]}, {host["cores"]} cores, Python {host["python"]}, Numba '
             f'{host["numba"]}, SciPy {host["scipy"]}; load average {host["load_average"]:.1f} '
             'at the start')
    console.print(where)
    if host['load_average'] > 0.5:
        console.print('Other processes are running: trust the ratios, least times above all.')
    reports: list[Report] = []
    remarks: list[str] = []
    record: dict[str, Any] = {'machine': host}
    status = 0

    def add(report: Report) -> None:
        report.show(console)
        reports.append(report)
        record[report.key] = report.record()

    if 'planner' in names:
        from benchmarks import bench_planner

        add(bench_planner.compare(quick=options.quick))
        for line in bench_planner.summary(reports[-1]):
            console.print(line)
            remarks.append(line)
        add(bench_planner.choices(quick=options.quick))
        add(bench_planner.start_up(quick=options.quick))
    if 'plant' in names:
        from benchmarks import bench_plant

        add(bench_plant.compare(quick=options.quick))
    if 'preemption' in names and _has_ros('preemption'):
        from benchmarks import bench_preemption

        add(bench_preemption.compare(quick=options.quick))
    if 'recorder' in names and _has_ros('recorder'):
        status = _recorder(options.quick, record)
    if options.json:
        options.json.write_text(json.dumps(record, indent=2) + '\n', encoding='utf-8')
    if options.page:
        texts = {report.key: report.markdown() for report in reports}
        texts['machine'] = '\n'.join([where + '.', '', *(f'* {x}' for x in remarks)])
        page = renewed(options.page.read_text(encoding='utf-8'), texts)
        options.page.write_text(page, encoding='utf-8')
    return status


def renewed(page: str, texts: dict[str, str]) -> str:
    """
    Replace what stands between the marks of a page.

    Parameters
    ----------
    page : str
        Markdown.
    texts : dict of str
        By the name in the marks; names that the page has not are left out.

    Returns
    -------
    str
        The page, outside the marks unchanged.

    """
    for name, text in texts.items():
        begin, end = f'<!-- begin {name} -->', f'<!-- end {name} -->'
        head, mark, rest = page.partition(begin)
        _, last, tail = rest.partition(end)
        if mark and last:
            page = f'{head}{begin}\n\n{text.strip()}\n\n{end}{tail}'
    return page


def _has_ros(name: str) -> bool:
    """Tell whether ROS 2 is installed, and say so if it is not."""
    if importlib.util.find_spec('rclpy') is None:
        print(f'{name}: ROS 2 (rclpy) is not installed')
        return False
    return True


def _recorder(quick: bool, record: dict[str, Any]) -> int:
    """Run the recorder's benchmark, a program of its own."""
    from benchmarks import bench_recorder

    before = sys.argv
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'recorder.json'
        sys.argv = [bench_recorder.__file__, '--json', str(file)]
        if quick:
            sys.argv += ['--seconds', '2', '--search-seconds', '1']
        try:
            status = bench_recorder.main()
        finally:
            sys.argv = before
        if file.exists():
            record['recorder'] = json.loads(file.read_text(encoding='utf-8'))
    return int(status)


if __name__ == '__main__':
    sys.exit(main())
