"""The picture of a run: what was commanded, what the actuator did, and what it was spared."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hmsa_ros.errors import BadInputError
from hmsa_ros.figures import style


def draw_run(
        path: str | Path, *, time: ArrayLike, stretch: ArrayLike, rate: ArrayLike,
        command_time: ArrayLike, command: ArrayLike, unshaped: tuple[ArrayLike, ArrayLike],
        targets: Sequence[tuple[float, float, float, float]], title: str = '') -> None:
    """
    Draw a run as PNG: command, response and phase plane, as the paper's Figs. 4 and 5.

    Parameters
    ----------
    path : str or Path
        File to write; an existing file is replaced.
    time, stretch, rate : array_like, shape (n,)
        Samples, in s and 1/s; times increase, 0 is the start of the sequence.
    command_time, command : array_like, shape (m,)
        Times in s from which the commands apply, not decreasing, and flux densities in T.
    unshaped : tuple of array_like, shape (n,)
        Stretch and rate of the response to plain steps at the times of the samples.
    targets : sequence of tuple of float
        (stretch, begin, arrival, end) of each setpoint, times in s.
    title : str
        Heading; default none.

    Raises
    ------
    BadInputError
        If shapes do not match, there is nothing to draw, or the file cannot be written.

    """
    time, stretch, rate, plain_stretch, plain_rate, command_time, command = (
        np.asarray(x, dtype=np.float64)
        for x in (time, stretch, rate, *unshaped, command_time, command))
    samples = (time, stretch, rate, plain_stretch, plain_rate)
    if any(x.shape != time.shape or x.ndim != 1 or not x.size for x in samples):
        raise BadInputError(
            'time, stretch, rate and the unshaped response have the shapes '
            f'{", ".join(str(x.shape) for x in samples)}: expected one-dimensional arrays of '
            'one length, not empty')
    if command_time.shape != command.shape or command.ndim != 1 or not command.size:
        raise BadInputError(
            f'command_time and command have the shapes {command_time.shape} and '
            f'{command.shape}: expected one-dimensional arrays of one length, not empty')
    begin, end = float(time[0]), float(time[-1])
    with style.picture(Path(path), 3.9) as figure:
        if title:
            figure.suptitle(title, fontsize=10)
        # A row of its own for the one legend, so that it covers nothing.
        panels = figure.subplot_mosaic(
            [['command', 'phase'], ['response', 'phase']], width_ratios=[1.45, 1.0],
            height_ratios=[1.0, 1.45])
        axes = panels['command']
        # Drawn to the end of the record: the last level holds.
        axes.step(
            np.append(command_time, max(end, float(command_time[-1]))) * 1e3,
            np.append(command, command[-1]) * 1e3, where='post', **style.SHAPED)
        for _, _, arrival, _ in targets:
            axes.axvline(arrival * 1e3, **style.TARGET)
        axes.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
        axes.set_xlim(begin * 1e3, end * 1e3)
        style.finish(axes, '', 'flux density $B$ [mT]', 'a')
        axes.tick_params(labelbottom=False)

        axes = panels['response']
        for i, (target, target_begin, arrival, target_end) in enumerate(targets):
            axes.plot(
                [target_begin * 1e3, min(target_end, end) * 1e3], [target, target], **style.TARGET,
                label='target, arrival' if i == 0 else None)
            axes.axvline(arrival * 1e3, **style.TARGET)
        axes.plot(time * 1e3, plain_stretch, label='unshaped', **style.UNSHAPED)
        axes.plot(time * 1e3, stretch, label='shaped (recorded)', **style.SHAPED)
        axes.set_xlim(begin * 1e3, end * 1e3)
        style.finish(axes, 'time $t$ [ms]', r'stretch $\lambda$ [1]', 'b')

        axes = panels['phase']
        axes.plot(plain_stretch, plain_rate, **style.UNSHAPED)
        axes.plot(stretch, rate, **style.SHAPED)
        axes.plot(
            [x[0] for x in targets], [0.0] * len(targets), label='equilibrium',
            **style.EQUILIBRIUM)
        style.finish(axes, r'stretch $\lambda$ [1]', r'stretch rate $\dot{\lambda}$ [1/s]', 'c')
        figure.align_ylabels([panels['command'], panels['response']])
        style.legend_below(figure, panels['response'], panels['phase'])
