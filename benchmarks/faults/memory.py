"""Memory of processes over time, and whether it grows."""

from dataclasses import dataclass
import math

import numpy as np

#: Growth in bytes over the second half of a life that counts as none.
SMALL = 2**20
#: The same in the first minutes of a life, when buffers fill.
SMALL_AT_FIRST = 16 * 2**20
#: Length of a life, in h of simulated time, from which leaks show.
LONG = 0.1


def used(pid: int) -> tuple[int, int, int]:
    """Return anonymous memory, PSS and RSS of a process in bytes; 0 for one that has ended."""
    found = {}
    try:
        with open(f'/proc/{pid}/smaps_rollup', encoding='ascii') as file:
            for line in file:
                name, _, rest = line.partition(':')
                if name in ('Anonymous', 'Pss', 'Rss'):
                    found[name] = int(rest.split()[0]) * 1024
    except (FileNotFoundError, ProcessLookupError):
        return 0, 0, 0
    return found.get('Anonymous', 0), found.get('Pss', 0), found.get('Rss', 0)


@dataclass(frozen=True)
class Sample:
    """Memory of a process at a moment, in bytes; leaks show in its own memory."""

    time: float  # in h of simulated time, all lives of the run together
    life: int  # number of the process among those of the same name
    age: float  # since this process was started, in h of simulated time
    own: int  # anonymous memory; the others depend on how many processes share libraries
    pss: int
    rss: int


@dataclass(frozen=True)
class Trend:
    """Change of memory over time."""

    slope: float  # bytes per simulated hour, common to all lives; each life has its own level
    error: float  # standard error of the slope; infinite for too few samples
    span: float  # longest part of a life that was used, in h
    samples: int  # number used

    @property
    def flat(self) -> bool:
        """Whether growth is small or within the noise."""
        small = SMALL if self.span >= LONG else SMALL_AT_FIRST
        return self.slope * self.span < small or self.slope < 3.0 * self.error


def trend(samples: list[Sample], settle: float) -> Trend:
    """
    Fit one slope through the second halves of all lives of a process.

    A leak persists and shows there too. Holes in the heap fill ever more slowly: by as much from
    the first hour to the second as from the second to the fourth.

    Parameters
    ----------
    samples : list of Sample
        In order of time.
    settle : float
        Minimum initial part of each life left out, in h: memory that is allocated once.

    Returns
    -------
    Trend
        Of the anonymous memory.

    """
    ages, sizes = [], []
    lives = {x.life for x in samples}
    span = 0.0
    used_lives = 0
    for life in sorted(lives):
        part = [x for x in samples if x.life == life and x.own > 0]
        begin = max(settle, 0.5 * max((x.age for x in part), default=0.0))
        part = [x for x in part if x.age >= begin]
        if len(part) < 3:
            continue
        used_lives += 1
        age = np.array([x.age for x in part])
        size = np.array([x.own for x in part], float)
        span = max(span, float(np.ptp(age)))
        ages.append(age - age.mean())
        sizes.append(size - size.mean())
    if not ages:
        return Trend(0.0, math.inf, 0.0, 0)
    x, y = np.concatenate(ages), np.concatenate(sizes)
    square = float(x @ x)
    if square == 0.0:
        return Trend(0.0, math.inf, span, x.size)
    slope = float(x @ y) / square
    rest = y - slope * x
    free = max(x.size - used_lives - 1, 1)
    # Successive samples are close in time, and memory grows in steps, so neighbours are not
    # independent observations. First-order autoregressive noise widens the error by this factor.
    spread = float(rest @ rest)
    near = float(rest[1:] @ rest[:-1]) / spread if spread > 0.0 else 0.0
    near = min(max(near, 0.0), 0.99)
    error = math.sqrt(spread / free / square * (1.0 + near) / (1.0 - near))
    return Trend(slope, error, span, int(x.size))
