"""
The parameter file of an identification, and its reading.

It is the YAML file of planner and plant. The uncertainty of the parameters is stored as
``identification.names``, ``identification.values`` and ``identification.covariance``, which the
planner uses as the prior of its feedback.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import yaml

from hmsa.errors import BadInputError
from hmsa.files import yaml_text
from hmsa.identification import quantities
from hmsa.identification.quantities import Known, PREFIX
from hmsa.interfaces.actuator import actuator_from, parameters_of, thermal_from
from hmsa.interfaces.parameters import BLOCK, number_of
from hmsa.interfaces.topics import PLANNER, PLANT
from hmsa.model.creep import CONSTANTS, Flow, FLOWS, MAXWELL
from hmsa.model.parameters import ActuatorParameters, Ellipsoid, Uncertainty
from hmsa.planning.shapers.request import as_errors, LARGEST_ERROR
from hmsa.runs.parameters import assume_one_joint, Entries, entries_of, values_of

if TYPE_CHECKING:  # slow to import, and not needed by nodes
    from hmsa.identification.result import Identification

# Parameters of coil and sensor, with their names in parameter files.
_OTHERS = (
    'coil_time_constant', 'stretch_bias', 'stretch_gain', 'sensor_latency', 'initial_stretch')
_LISTS = dict(zip(
    ('viscoelastic.ratio', 'viscoelastic.time', *(f'viscoelastic.{x}' for x in CONSTANTS)),
    zip(*map(tuple.__add__, quantities.BRANCHES, quantities.FLOWING), strict=True), strict=True))
# Half a 95 % interval, or half an axis of the ellipsoid by dimension, in standard deviations.
_HALF_95 = (0.0, 1.96, 2.448, 2.795, 3.080)
# Parameters of the motion, in the order of `hmsa.model.parameters.Errors`.
_MISMATCH = ('shear_modulus', 'damping_coefficient', 'chain_limit', 'remanence')
_RANKS = {'': 1, PLANT: 2, PLANNER: 3}


@dataclass(frozen=True, eq=False)
class Belief:
    """Contents of a parameter file: an actuator, and the uncertainty of its parameters."""

    actuator: ActuatorParameters
    others: dict[str, float]  # of coil and sensor
    settings: dict[str, Any]  # all parameters in the file, by dotted name
    known: Known

    def at_temperature(self, temperature: float) -> 'Belief':
        """Return the values at a temperature in degrees Celsius."""
        actuator, others = self.actuator.at_temperature(temperature), dict(self.others)
        if 'coil_time_constant' in others:
            others['coil_time_constant'] = self.actuator.thermal.coil_time_constant(
                others['coil_time_constant'], temperature)
        return replace(self, actuator=actuator, others=others)

    def number(self, name: str, default: float) -> float:
        """Return a setting that is a number."""
        value = number_of(self.settings.get(name))
        return default if value is None else value


def read_belief(path: Path | None, entries: Entries | None = None) -> Belief:
    """
    Read a parameter file.

    Parameters
    ----------
    path : Path, optional
        YAML file for ROS 2; without one all parameters have their defaults.
    entries : list, optional
        Its contents, if already read.

    Returns
    -------
    Belief
        With the defaults of the nodes for missing parameters.

    Raises
    ------
    BadInputError
        If the file cannot be read or a value is invalid.

    """
    # Parameters of a node override those for all nodes, and the planner's those of the plant.
    if entries is None:
        entries = [] if path is None else entries_of(path)
    assume_one_joint(path, entries)
    settings: dict[str, Any] = {
        name: value for _, name, value in sorted(entries, key=lambda x: _RANKS.get(x[0], 0))}
    values = values_of({f'{PLANNER}.{x}': y for x, y in settings.items()}, PLANNER, BLOCK)
    others = {x: _number(path, x, settings[x]) for x in _OTHERS if x in settings}
    flow = FLOWS.get(str(settings.get('viscoelastic.flow')), MAXWELL)
    for key, names in _LISTS.items():
        value = settings.get(key) if _has(flow, key) else None
        if isinstance(value, list) and len(value) > len(names):
            raise BadInputError(
                f'{path} gives {len(value)} values of {key}: expected at most {len(names)}, '
                'since as many branches of creep are identified')
        if isinstance(value, list):
            others |= {x: _number(path, key, y) for x, y in zip(names, value, strict=False)}
    for ratio, time in quantities.BRANCHES:
        if others.get(ratio) == 0.0:
            others.pop(time, None)
    try:
        known = Known.read(settings)
    except BadInputError as error:
        raise BadInputError(f'{path}: {error}') from error
    return Belief(actuator_from(values), others, settings, known)


def errors_of(belief: Belief, others: tuple[float, float, float]) -> Uncertainty:
    """
    Return the uncertainty of the block for the shaper minimax.

    It is a 95 % region, relative to the values: the ellipsoid of G, damping coefficient, J_lim and
    remanence from their covariance, or intervals if fewer than two of them were identified.
    ``others`` are the relative errors of G, damping coefficient and J_lim for those that were not
    identified.
    """
    sizes = [*others, 0.0]
    covariance = np.diag(np.square(sizes))
    numbers, known = belief.actuator.numbers, belief.known
    rows = [(i, known.names.index(x), numbers[x]) for i, x in enumerate(_MISMATCH)
            if x in known.names and 0.0 < numbers[x] < math.inf]
    factor = _HALF_95[len(rows)]
    for i, row, first in rows:
        for j, column, second in rows:
            covariance[i, j] = factor ** 2 * known.covariance[row, column] / (first * second)
    if len(rows) < 2:
        a, b, c = (min(math.sqrt(x), LARGEST_ERROR) for x in np.diag(covariance)[:3])
        return a, b, c
    lengths, axes = np.linalg.eigh(covariance)
    # The shortest of four axes is left out: it would double the cases.
    found = [math.sqrt(max(lengths[i], 0.0)) * axes[:, i] for i in (3, 2, 1)]
    return Ellipsoid(tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in found))


def errors_from(file: str, others: Sequence[float]) -> Uncertainty:
    """
    Return `errors_of` for a file written by ``hmsa identify --out``, or the others without a file.

    Raise `BadInputError` if the file cannot be read or has no covariance.
    """
    errors = as_errors(others)
    if not file or isinstance(errors, Ellipsoid):
        return errors
    belief = read_belief(Path(file))
    if not set(_MISMATCH) & set(belief.known.names):
        raise BadInputError(
            f'{file} has no covariance of {", ".join(_MISMATCH)}: expected a file that hmsa '
            'identify --out wrote (minimax_file), or an empty name')
    return errors_of(belief, errors)


def _has(flow: Flow, key: str) -> bool:
    """Return whether a list of values per branch belongs to a flow rule, or to all."""
    name = key.removeprefix('viscoelastic.')
    return name not in CONSTANTS or CONSTANTS[name] in flow.constants


def _number(path: Path | None, name: str, value: object) -> float:
    number = number_of(value)
    if number is None:
        raise BadInputError(f'{path} gives {name} as {value!r}: expected a number')
    return number


def file_text(found: 'Identification', belief: Belief, run: str, now: datetime) -> str:
    """
    Return the parameter file of an identification; ``run`` names the recording in comments.

    Settings of the belief that were not identified are kept.
    """
    lines = [
        f'# Parameters of an actuator, identified from {run}',
        f'# on {now.isoformat(" ", "seconds")} by hmsa identify.',
        f'# Verdict: {found.verdict}: {found.reason}.',
        *([f'# Accepted: what the model lacks costs {100.0 * found.cost:.2g} % of a step.']
          if found.verdict != 'identified' else []),
        *([f'# At {found.recording.temperature:.4g} degrees Celsius (thermal.reference).']
          if math.isfinite(found.recording.temperature) else []),
        f'# Noise {found.noise_std:.3g} of {found.recording.coordinate.name} a sample, '
        f'{found.samples} samples.',
        *(f'# Note: {x}.' for x in found.warnings),
        '/**:', '  ros__parameters:']
    written: dict[str, str] = {}
    actuator = quantities.actuator_of(found.values)
    for name, value in actuator.numbers.items():
        source = 'time_unit' if name == 'density' and 'time_unit' in found.names else name
        written[f'actuator.{name}'] = _line(f'actuator.{name}', value, found, source)
    for key, value in parameters_of(actuator).items():
        if key not in written:
            scale = key == f'law.{found.shown("shear_modulus")[0]}'
            name = key.removeprefix('actuator.')
            own = [name] if name in (*quantities.FACTORS, 'bulk_ratio') else [
                x for names in quantities.SECONDARY for x in names if x.startswith(key)]
            sought = ['shear_modulus'] if scale else [x for x in own if x in found.names] or [
                x for x, (constant, _) in quantities.constants_of(actuator.law).items()
                if constant.name == key and x in found.names]
            written[key] = _line(key, value, found, *sought)
    thermal, temperature = (
        belief.actuator.thermal or thermal_from(belief.settings), found.recording.temperature)
    known = math.isfinite(temperature)
    if known:
        thermal = thermal.at(temperature)
    for key, value in (thermal.parameters or (
            {'thermal.reference': temperature} if known else {})).items():
        written[key] = _line(key, value, found)
    for name in _OTHERS:
        if name in found.names or name in belief.others:
            written[name] = _line(name, found.values[name], found, name)
    held = [i for i, pair in enumerate(quantities.BRANCHES)
            if found.values[pair[0]] > 0.0 or set(pair + quantities.FLOWING[i]) & set(found.names)]
    flow = quantities.flow_of(found.values, found.names)
    creeps = any(x in found.names for names in _LISTS.values() for x in names)
    if creeps and flow is not MAXWELL:
        written['viscoelastic.flow'] = f'    viscoelastic.flow: {flow.name}'
    for key, names in _LISTS.items():
        if creeps and _has(flow, key):
            written[key] = _line(
                key, [found.values[names[i]] for i in held], found,
                *(names[i] for i in held if names[i] in found.names))
    for key, value in belief.settings.items():
        if not key.startswith(PREFIX):
            written.setdefault(key, _line(key, value, found))
    # Undetermined parameters have no covariance.
    lines += [*written.values(), *known_lines(Known.of(
        found.names, tuple(float(found.values[x]) for x in found.names), found.covariance)
        if np.all(np.isfinite(found.covariance)) else Known())]
    return '\n'.join(lines) + '\n'


def belief_in(text: str) -> Belief:
    """Return the contents of a text of `file_text`."""
    settings = yaml.safe_load(text)['/**']['ros__parameters']
    return read_belief(None, [('', x, y) for x, y in settings.items()])


def known_lines(known: Known, joint: str = '') -> list[str]:
    """Return the lines of a parameter file for the uncertainty of the parameters."""
    return [
        '    # The parameters named, their values and the covariance of these, row after row, in '
        'SI units.',
        *(f'    {joint}{key}: {yaml_text(x)}' for key, x in known.parameters().items())]


def _line(key: str, value: Any, found: 'Identification', *names: str) -> str:
    """Return the line of a value, with standard deviations and intervals of its estimates."""
    line, notes = f'    {key}: {yaml_text(value)}', []
    for name in names:
        label, estimate = found.shown(name)
        if not key.endswith(label):
            label, estimate = name, found.parameters[name]
        if not estimate.free:
            return f'{line}  # not identified'
        unit = f' {quantities.quantity_of(name).unit}' if quantities.quantity_of(name).unit else ''
        alone = len(names) == 1 and (key.endswith(label) or key in _LISTS)
        notes.append(
            f'{"" if alone else f"{name} "}standard deviation {estimate.std:.3g}{unit}, 95 % '
            f'interval {estimate.low:.6g} to {estimate.high:.6g}')
    return f'{line}  # {"; ".join(notes)}' if notes else line
