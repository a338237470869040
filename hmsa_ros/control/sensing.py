"""What an estimate says of a sensor to whoever judges by it."""

import math

import numpy as np

from hmsa_ros.estimation import Estimate, Prior
from hmsa_ros.estimation.motion import rest
from hmsa_ros.judge.records import Sensor
from hmsa_ros.model.laws.coordinate import coordinate_of

# What the judge calls figures of a sensor, and the share of what was not known of one before
# below which it has been found.
_SENSOR = {'stretch_bias': 'bias', 'stretch_gain': 'gain', 'sensor_latency': 'latency'}
_FOUND = 0.3
# A bias of fewer deviations does not show.
_SHOWS = 3.0


def sensor_of(found: Estimate, prior: Prior) -> Sensor:
    """
    Return what an estimate has found of a sensor; what it has not is as given.

    What a force leaves open of a bias counts.
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
        together = float(both / math.sqrt(one * two))
    return Sensor(**figures, together=together)


def _shows_bias(found: Estimate) -> bool:
    """
    Return whether samples show that a sensor may have a bias.

    Either it is known not to be 0, or the block is seen beside its rest without field, where a
    force may hide the larger part of a bias.
    """
    at = rest(found.values, found.free, 0.0)
    if at is None:
        return False
    value, covariance = found.values['stretch_bias'], found.covariance[:-2, :-2]
    itself = np.array([float(x == 'stretch_bias') for x in found.free])
    shown = at[0] + value - coordinate_of(found.values['law']).rest
    return any(abs(off) > _SHOWS * math.sqrt(max(float(by @ covariance @ by), 0.0))
               for off, by in ((value, itself), (shown, itself + at[2])))
