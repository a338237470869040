"""Parameters of a run, from a recording or from a parameter file of the nodes."""

from collections.abc import Iterable, Iterator, Mapping
import json
from pathlib import Path
from typing import Any

from hmsa.bag.limits import load_yaml
from hmsa.errors import assume, BadInputError, BagError, excerpt, nearest
from hmsa.files import read_at_most
from hmsa.interfaces import parameters as shared
from hmsa.interfaces.actuator import actuator_from, creep_from
from hmsa.interfaces.parameters import number_of, ParameterSpec, sections_of
from hmsa.interfaces.topics import NODES, PLANNER, PLANT
from hmsa.model.creep import Creep
from hmsa.model.parameters import ActuatorParameters, paper_actuator

# Parameter files have a few dozen entries.
_LARGEST_FILE = 1 << 20

#: Node, dotted name and value of each parameter in a file; the node is empty for all nodes.
Entries = list[tuple[str, str, object]]


def of_joint(parameters: Mapping[str, object], joint: str, name: str) -> object:
    """Return the value for one joint, or else for all; None if it is not set."""
    node, _, parameter = name.partition('.')
    own = parameters.get(f'{node}.{joint}.{parameter}')
    return parameters.get(name) if own is None else own


def recorded(custom_data: Mapping[str, str], space: str) -> dict[str, object]:
    """Return the parameters of planner and plant in a namespace by ``'node.name'``."""
    from hmsa.bag.metadata import recorded_parameters  # imports YAML

    parameters: dict[str, object] = {}
    for node in (PLANNER, PLANT):
        for name, text in recorded_parameters(custom_data, node, space).items():
            try:
                parameters[f'{node}.{shared.present_name(name)}'] = json.loads(text)
            except (ValueError, RecursionError):
                parameters[f'{node}.{shared.present_name(name)}'] = text
    return parameters


def named_joint(parameters: Mapping[str, object]) -> str:
    """Return the joint name in the parameters of nodes with one joint; empty if there is none."""
    for node in (PLANT, PLANNER):
        several = parameters.get(f'{node}.joints')
        if isinstance(several, list) and several:
            return str(several[0]) if len(several) == 1 else ''
        if name := parameters.get(f'{node}.{shared.JOINT.name}'):
            return str(name)
    return ''


def actuators(
        parameters: Mapping[str, object], given: Mapping[str, object], joint: str
) -> tuple[ActuatorParameters, ActuatorParameters, bool, list[str]]:
    """
    Return the blocks of plant and planner, whether they are known, and notes.

    Raise `BadInputError` if the given parameters belong to an actuator with another kind of
    position.
    """
    # Given parameters are those of the real block. Without any parameters, use the example block.
    found: dict[str, ActuatorParameters] = {}
    notes = []
    for node in (PLANT, PLANNER):
        values = {x: number_of(of_joint(parameters, joint, f'{node}.{x}')) for x in _NAMES}
        if all(values[x.name] is not None for x in shared.ACTUATOR):
            try:
                found[node] = actuator_from(
                    {k: v for k, v in values.items() if v is not None}
                    | _own(parameters, joint, node, (*shared.LAW, *shared.THERMAL)))
            except BadInputError as error:
                notes.append(f'The parameters of the {node} in the bag cannot be used: {error}.')
    if given:
        own = actuator_from(
            values_of({}, PLANT, shared.ACTUATOR) | _own(given, joint, PLANT, shared.BLOCK))
        for node, other in found.items():
            if other.coordinate != own.coordinate:
                raise BadInputError(
                    f'the actuator of the parameter file has {own.coordinate.plural}, that of the '
                    f'{node} in the bag {other.coordinate.plural}: expected the file of the '
                    'recorded actuator; leave out --params-file to use the parameters in the bag')
        found[PLANT] = own
    if not found:
        notes.append(
            "The recording does not contain the actuator's parameters: those of the example "
            'block are used, so what is simulated here (unshaped steps, prediction, equilibria, b '
            'and tau) may not match your actuator; name a parameter file with --params-file.')
    plant = found.get(PLANT) or found.get(PLANNER) or paper_actuator()
    planner = found.get(PLANNER) or plant
    if plant != planner:
        notes.append(
            'The planner and the plant had different parameters of the actuator: see the table '
            'of parameters.')
    try:
        if creep := creep_of({**parameters, **given}, joint):
            known = creep == creep_of(parameters, joint, PLANNER)
            notes.append(
                'The elastomer of the plant creeps (viscoelastic.*)'
                + ('.' if known else ', which the planner does not know.'))
    except BadInputError as error:
        notes.append(f'What the plant says of creep cannot be used: {error}.')
    return plant, planner, bool(found), notes


def creep_of(parameters: Mapping[str, object], joint: str, node: str = PLANT) -> Creep:
    """Return the viscoelastic branches of the plant or of the planner of a run."""
    return creep_from(_own(parameters, joint, node, shared.VISCOELASTIC))


def _own(
        parameters: Mapping[str, object], joint: str, node: str, specs: Iterable[ParameterSpec]
) -> dict[str, Any]:
    """Return the values that are set for some parameters, for a joint or for all."""
    found = {x.name: of_joint(parameters, joint, f'{node}.{x.name}') for x in specs}
    return values_of(
        {f'{node}.{name}': value for name, value in found.items()}, node,
        [x for x in specs if found[x.name] is not None])


# All parameters with such a first part.
_KNOWN = {x.name for x in (*shared.BLOCK, *shared.VISCOELASTIC, *shared.MISMATCH)}
_GROUPS = {x.partition('.')[0] for x in _KNOWN}
_NAMES = tuple(
    name for x in shared.ACTUATOR for name in (x.name, f'mismatch.{x.name.partition(".")[2]}'))


def read_parameter_file(
        path: str | Path, entries: Entries | None = None) -> dict[str, object]:
    """
    Read a YAML parameter file, or use its entries; return values by ``'node.name'``.

    Raise `BadInputError` if the file cannot be read or sets no parameter of the actuator.
    """
    entries = entries_of(Path(path)) if entries is None else entries
    # Parameters for all nodes come first, so that those of a node override them.
    found = {f'{node}.{name}': value for own in (False, True) for node in (PLANNER, PLANT)
             for key, name, value in entries if key == (node if own else '')}
    if not any(name.partition('.')[2].endswith(x.name) for name in found for x in shared.BLOCK):
        raise BadInputError(
            f'{path} sets no parameter of the actuator in a section for planner, plant or all '
            f'nodes (/**): expected some of {", ".join(x.name for x in shared.ACTUATOR)}')
    return found


def values_of(
        parameters: Mapping[str, object], node: str, specs: Iterable[ParameterSpec]
) -> dict[str, Any]:
    """
    Return a node's values by name: those set as ``'node.name'``, else the defaults.

    Raise `BadInputError` if a value has the wrong type or is out of range.
    """
    return {x.name: x.taken(parameters.get(f'{node}.{x.name}', x.default)) for x in specs}


def entries_of(path: Path) -> Entries:
    """
    Return the parameters in a file for the nodes of this package.

    Sections for other nodes are not used, which is said. Raise `BadInputError` if the file cannot
    be read, or has a parameter that does not exist, which nodes refuse too.
    """
    try:
        document = load_yaml(
            read_at_most(path, _LARGEST_FILE, 'a parameter file of at most that').decode('utf-8'))
    except BadInputError:
        raise
    except (OSError, ValueError, BagError) as error:
        raise BadInputError(
            f'{path} cannot be read ({getattr(error, "strerror", None) or error}): expected a '
            'parameter file (YAML)') from error
    if not isinstance(document, dict):
        raise BadInputError(
            f'{path} has no ros__parameters: expected a parameter file as hmsa init writes it')
    entries = []
    spaces: dict[str, list[str]] = {}
    for key, inner in document.items():
        if isinstance(inner, dict) and (str(key).startswith('/') or key in NODES) and not any(
                sections_of({key: inner})):
            raise BadInputError(
                f'{path} has no ros__parameters in its section {excerpt(key)}, but '
                f'{excerpt(", ".join(map(str, inner)))}: expected a file as hmsa init writes it')
    sections = list(sections_of(document)) or [('/**', document)]
    for section, values in sections:
        node = section.rpartition('/')[2]
        if node not in ('*', '**', *NODES):
            assume(
                f'{path}: its section {excerpt(section)} is not used: expected /**, '
                f'{", ".join(NODES[:2])} or {NODES[2]}, the nodes that read parameters of '
                'an actuator')
            continue
        spaces.setdefault(node, []).append(section)
        for name, value in _flat(values):
            entries.append((
                '' if node.startswith('*') else node, shared.present_name(name), value))
    for node, several in spaces.items():
        if node in NODES and len(exact := [x for x in several if '*' not in x]) > 1:
            assume(
                f'{path}: {" and ".join(exact)} are sections for nodes {node} in several '
                'namespaces: values of later ones are taken where both have them')
    _check_names(path, entries)
    return entries


def assume_one_joint(path: Path | None, entries: Entries) -> None:
    """State that parameters of single joints are not used where one actuator is wanted."""
    known = _KNOWN | shared.PLAIN_NAMES
    if single := dict.fromkeys(
            joint for _, joint, own in _of_joints(entries) if joint and own in known):
        assume(
            f'{path or "the parameter file"}: parameters of {", ".join(single)} are not used, '
            'only those of all joints: expected those of one actuator; write a file for each')


def _of_joints(entries: Entries) -> Iterator[tuple[str, str, str]]:
    """Yield the name of each parameter, its joint, empty for all, and its name without that."""
    joints = [x for _, name, value in entries if name == 'joints' and isinstance(value, list)
              for x in value]
    known = _KNOWN | shared.PLAIN_NAMES
    for _, name, _ in entries:
        first, _, rest = name.partition('.')
        single = first in joints or first not in _GROUPS | shared.FOREIGN and (
            '.' in rest or rest in known)
        yield (name, first, rest) if single else (name, '', name)


def _check_names(path: Path, entries: Entries) -> None:
    """Raise `BadInputError` for a name that no node has; those for others are not looked at."""
    known = _KNOWN | shared.PLAIN_NAMES
    for name, _, own in _of_joints(entries):
        if own in known or own.partition('.')[0] in shared.FOREIGN:
            continue
        group = f'{own.partition(".")[0]}.' if '.' in own else ''
        near = [x for x in known if x.startswith(group)] or known
        raise BadInputError(
            f'{path}: parameter {excerpt(name)} does not exist: expected one of planner and '
            f'plant, such as {nearest(own, near)}')


def _flat(values: Mapping[Any, object], before: str = '') -> Iterator[tuple[str, object]]:
    """Yield the values of nested mappings with their dotted names."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{before}{key}.')
        else:
            yield f'{before}{key}', value
