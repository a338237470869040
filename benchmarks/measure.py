"""Timing of several contenders side by side, and their table."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
import math
import os
from pathlib import Path
import platform
import statistics
from time import perf_counter
from typing import Any

from benchmarks.sheet import Sheet

Clock = Callable[[], tuple[float, float]]


@dataclass(frozen=True)
class Row:
    """One measured line of a table."""

    name: str
    setting: str = ''  # its tolerance or other setting
    least: float | None = None  # seconds for one unit of work; None where it could not be measured
    median: float | None = None
    error: float | None = None  # the largest
    note: str = ''


@dataclass(frozen=True)
class Contender:
    """A function to be timed."""

    name: str
    setting: str  # its tolerance or other setting
    clock: Clock  # runs for a while; returns minimum and median seconds for one unit of work
    error: float  # the largest


def stopwatch(work: Callable[[], object], units: float, *, least: float = 0.1) -> Clock:
    """Return a clock of a function that does ``units`` of work, run for ``least`` s or more."""
    def clock() -> tuple[float, float]:
        spans: list[float] = []
        end = perf_counter() + least
        while not spans or perf_counter() < end:
            begin = perf_counter()
            work()
            spans.append((perf_counter() - begin) / units)
        return min(spans), statistics.median(spans)

    return clock


def race(contenders: Sequence[Contender], rounds: int) -> list[Row]:
    """
    Time contenders in turns, so that disturbances of the machine affect all of them.

    A row contains the minimum of all turns and the median of their medians.
    """
    turns: list[list[tuple[float, float]]] = [[] for _ in contenders]
    for _ in range(rounds):
        for contender, times in zip(contenders, turns, strict=True):
            times.append(contender.clock())
    return [
        Row(x.name, x.setting, min(t[0] for t in times),
            statistics.median(t[1] for t in times), x.error)
        for x, times in zip(contenders, turns, strict=True)]


def loosest(
        errors: Callable[[float], float], limit: float, *, start: float = 1e-6,
        end: float = 1e-14) -> float:
    """
    Find the loosest tolerance that keeps an error limit.

    Parameters
    ----------
    errors : callable
        Error as a function of tolerance; NaN where it fails.
    limit : float
        Error limit.
    start, end : float
        Range of tolerances to try, three per decade.

    Returns
    -------
    float
        Tolerance.

    Raises
    ------
    ArithmeticError
        If no tolerance keeps the limit.

    """
    tolerance = start
    while tolerance >= 0.99 * end:
        if errors(tolerance) <= limit:
            return tolerance
        tolerance *= 10.0 ** (-1.0 / 3.0)
    raise ArithmeticError(f'no tolerance down to {end:g} keeps an error of {limit:g}')


def text_of_time(seconds: float | None) -> str:
    """Return a time in a suitable unit with three digits."""
    if seconds is None:
        return '-'
    for factor, unit in ((1.0, 's'), (1e3, 'ms'), (1e6, 'us')):
        if seconds * factor >= 1.0:
            return f'{seconds * factor:.3g} {unit}'
    return f'{seconds * 1e9:.3g} ns'


def table(
        key: str, title: str, unit: str, error: str, rows: Sequence[Row],
        remarks: Sequence[str] = ()) -> Sheet:
    """Return rows as a table, with headings of times and errors, compared with the first one."""
    head = ['', 'setting', unit, 'median', 'ratio', error, 'remark']
    base = rows[0].least
    body = []
    for row in rows:
        ratio = '-'
        if row.least is not None and base is not None:
            ratio = f'{row.least / base:.3g}'
            if row.least / base >= 1000.0:
                ratio = f'{row.least / base:,.0f}'
        off = '-' if row.error is None or math.isnan(row.error) else f'{row.error:.1e}'
        body.append([
            row.name, row.setting, text_of_time(row.least), text_of_time(row.median), ratio, off,
            row.note])
    # An empty column is left out.
    used = [i for i in range(len(head))
            if i == 0 or any(cells[i] not in ('', '-') for cells in body)]
    return Sheet(
        key, title, [head[i] for i in used], [[cells[i] for i in used] for cells in body],
        {'rows': [asdict(x) for x in rows]}, remarks=remarks)


def ros_domain() -> int:
    """Return the caller's ROS domain, else one derived from the number of this process."""
    return int(os.environ.get('ROS_DOMAIN_ID') or 1 + os.getpid() % 101)


def keep_local() -> None:
    """Give the ROS processes of this one a domain of their own on this host, and these sources."""
    os.environ |= {
        'ROS_DOMAIN_ID': str(ros_domain()), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'PYTHONPATH': str(Path(__file__).resolve().parent.parent), 'PYTHONUNBUFFERED': '1'}


def machine() -> dict[str, Any]:
    """Return processor, cores, versions and the current load average."""
    import numpy
    import scipy

    processor = platform.processor() or platform.machine()
    try:
        with open('/proc/cpuinfo', encoding='utf-8') as file:
            names = [x.split(':', 1)[1].strip() for x in file if x.startswith('model name')]
        processor = names[0] if names else processor
    except OSError:
        pass  # Not Linux: the plain name has to do.
    load = os.getloadavg()[0] if hasattr(os, 'getloadavg') else float('nan')
    return {
        'processor': processor, 'cores': os.cpu_count(), 'load_average': load,
        'python': platform.python_version(),
        'numpy': numpy.__version__, 'scipy': scipy.__version__}
