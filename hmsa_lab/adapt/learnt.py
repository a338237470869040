"""Learnt parameters of an actuator: as a model to plan with, as its sensor, and as a file."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
import itertools
import math
from pathlib import Path

import numpy as np

from hmsa.errors import BadInputError
from hmsa.files import write_text, yaml_text
from hmsa.identification.files import known_lines
from hmsa.identification.quantities import (
    BRANCHES,
    derivative,
    Known,
    quantity_of,
    THERMAL,
    values_of,
)
from hmsa.interfaces.actuator import parameters_of
from hmsa.judge.records import SensorModel
from hmsa.model.laws.record import coordinate_of
from hmsa.planning.planner import Believed
from hmsa.planning.timeline import JointModel
from hmsa_lab.adapt.estimator import CREEPS, StateEstimate
from hmsa_lab.adapt.motion import followed, rest
from hmsa_lab.adapt.prior import Prior

# A parameter has changed if it differs by this fraction and this many standard deviations.
_NEWS, _SURE = 1e-3, 0.5
# A force counts as known from this many standard deviations on.
_FORCED = 2.0
# Parameters of planner and plant in addition to those of the block.
_OTHERS = ('coil_time_constant', 'stretch_bias', 'stretch_gain')
# Names of sensor figures in the judge, and the fraction of the prior standard deviation below
# which such a figure counts as determined.
_SENSOR = {'stretch_bias': 'bias', 'stretch_gain': 'gain', 'sensor_latency': 'latency'}
_FOUND = 0.3
# A bias of fewer standard deviations is not significant.
_SHOWS = 3.0


def learnt_model(
        model: JointModel, estimate: StateEstimate, held: float,
        sure: float = CREEPS) -> JointModel:
    """
    Return a model with an estimate's parameters, or the same model if these cannot hold a stretch.

    The model creeps if creep is known by more than ``sure`` standard deviations; the default is
    the value for a move.
    """
    try:
        found = estimate.model(model.options, sure)
        found.material.check(held, 'stretch')
    except BadInputError:
        return model
    return found


def as_of_path(model: JointModel, before: JointModel, estimate: StateEstimate) -> JointModel:
    """
    Return a model learnt from a path, with the force of the previous model unless it is known.

    Around a single equilibrium, as in a wave, a force is indistinguishable from a bias and would
    shift the mean.
    """
    force = before.options.constant_force
    if abs(model.options.constant_force - force) >= _FORCED * estimate.deviations.get(
            'constant_force', 0.0):
        return model
    return replace(model, options=replace(model.options, constant_force=force))


def initial_state(estimate: StateEstimate, model: JointModel, shift: float = 0.0) -> Believed:
    """Return the initial state of a plan with a model, with positions shifted."""
    stretch, rate, material = estimate.stretch, estimate.rate, model.material
    apart = estimate.values['behind'][-2 - 2 * len(material.modes.ratios):] if (
        material.modes.ratios) else (0.0, 0.0)
    first, speed, *others = (y + x for x, y in zip(apart, itertools.cycle((stretch, rate))))
    branches = followed(estimate.values, first) if material.creep else ()
    return first + shift, speed, (*branches, *(
        x * model.units.time if i % 2 else x + shift for i, x in enumerate(others)))


def differs(model: JointModel, estimate: StateEstimate) -> bool:
    """Return whether an estimate differs significantly from a model."""
    creep = model.actuator.creep
    if bool(creep) is not bool(estimate.actuator.creep):
        return True
    branch = dict(zip(BRANCHES[0], (*creep.ratios, *creep.times), strict=False))
    for key in estimate.free:
        value = estimate.values[key]
        before = branch.get(key, getattr(
            model.options, key, getattr(model.actuator, key, value)))
        if abs(value - before) > max(_NEWS * abs(value), _SURE * estimate.deviations[key]):
            return True
    return False


def same_parameters(model: JointModel, other: JointModel) -> bool:
    """Return whether two models differ by less than a significant change."""
    one, two = (values_of(x.actuator, x.others) for x in (model, other))
    return model.actuator.creep == other.actuator.creep and all(
        math.isclose(one[x], two[x], rel_tol=_NEWS) if isinstance(one[x], float)
        else one[x] == two[x] for x in one)


def sensor_of(found: StateEstimate, prior: Prior) -> SensorModel:
    """
    Return the sensor according to an estimate; undetermined figures keep their given values.

    The uncertainty of a bias includes that of a force.
    """
    before, sure = np.diag(prior.covariance), np.diag(found.covariance)
    known = [x for i, x in enumerate(found.free) if x in _SENSOR and i != found.gain and (
        _shows_bias(found) if x == 'stretch_bias' else sure[i] < _FOUND**2 * before[i])]
    figures = {_SENSOR[x]: found.values[x] for x in known} | {
        f'{_SENSOR[x]}_std': found.deviations[x] for x in known}
    together = 0.0
    if 'stretch_bias' in known and 'stretch_gain' in known:
        pair = [found.free.index(x) for x in ('stretch_bias', 'stretch_gain')]
        (one, both), (_, two) = found.covariance[np.ix_(pair, pair)]
        # A figure at its bound has no deviation.
        both_sure = math.sqrt(one * two)
        together = float(both / both_sure) if both_sure else 0.0
    return SensorModel(**figures, together=together)


def _shows_bias(found: StateEstimate) -> bool:
    """
    Return whether samples show that a sensor may have a bias.

    Either the bias differs significantly from 0, or the block rests off its zero-field
    equilibrium, where a force may hide the larger part of a bias.
    """
    at = rest(found.values, found.free, 0.0)
    if at is None:
        return False
    value, covariance = found.values['stretch_bias'], found.covariance[:-2, :-2]
    itself = np.array([float(x == 'stretch_bias') for x in found.free])
    shown = at[0] + value - coordinate_of(found.values['law']).rest
    return any(abs(off) > _SHOWS * math.sqrt(max(float(by @ covariance @ by), 0.0))
               for off, by in ((value, itself), (shown, itself + at[2])))


def known_of(estimate: StateEstimate) -> Known:
    """Return the uncertainty of the parameters of an estimate."""
    # A suspected parameter that is not in use has no standard deviation.
    places = [i for i, x in enumerate(estimate.free)
              if estimate.deviations[x] > 0.0 and i != estimate.gain and x not in THERMAL]
    names = tuple(estimate.free[i] for i in places)
    values = tuple(estimate.values[x] for x in names)
    scale = np.array([derivative(x, y) for x, y in zip(names, values, strict=True)])
    return Known(
        names, values, np.outer(scale, scale) * estimate.covariance[np.ix_(places, places)])


def file_text(estimates: Mapping[str, StateEstimate], now: datetime) -> str:
    """Return a parameter file with the learnt values by joint; '' names all joints."""
    lines = [
        f'# Parameters that feedback learnt until {now.isoformat(" ", "seconds")}.',
        '# Planner and plant take it after their own parameter file.',
        '/**:', '  ros__parameters:']
    for joint, estimate in estimates.items():
        prefix = f'{joint}.' if joint else ''
        given = parameters_of(estimate.actuator) | {
            x: estimate.values[x] for x in _OTHERS if x in estimate.free}
        for key, value in given.items():
            name = key.rpartition('.')[2]
            note = f'  # standard deviation {estimate.deviations[name]:.3g} ' \
                f'{quantity_of(name).unit}'.rstrip() if name in estimate.free else ''
            lines.append(f'    {prefix}{key}: {yaml_text(value)}{note}')
        lines += known_lines(known_of(estimate), prefix)
    return '\n'.join(lines) + '\n'


def save(file: str, estimates: Mapping[str, StateEstimate | None], *, by_joint: bool) -> str:
    """
    Write the learnt parameters by joint, and return a confirmation.

    Raises `BadInputError` if nothing was learnt yet, or if the file cannot be written.
    """
    if not file:
        raise BadInputError('parameter feedback_file is empty: expected the file to write to')
    found: dict[str, StateEstimate] = {}
    for name, estimate in estimates.items():
        if estimate is None or not estimate.trusted:
            why = 'no samples yet' if estimate is None else estimate.trouble
            raise BadInputError(
                f'the estimate of joint {name} is not saved: {why}; expected samples on '
                'joint_states that fit')
        found[name if by_joint else ''] = estimate
    write_text(Path(file), file_text(found, datetime.now()))
    return f'saved the estimate to {file}'
