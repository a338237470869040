"""
What launch files use of ROS 2's ``launch`` and ``launch_ros``, where these are not installed.

The signatures, and what becomes of arguments, conditions and parameters, are those of Jazzy; a
test holds them against the real packages where there are any. `evaluate` turns a launch file and
arguments into the commands that ``ros2 launch`` would run.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
import importlib.util
from pathlib import Path
import sys
from types import ModuleType
from typing import Any

import yaml

# Keywords that an action, and a process, take besides their own.
_ACTION = {'condition'}
_PROCESS = _ACTION | {
    'prefix', 'output', 'output_format', 'log_cmd', 'on_exit', 'respawn', 'respawn_delay',
    'respawn_max_retries', 'cwd', 'env', 'additional_env', 'shell', 'sigterm_timeout',
    'sigkill_timeout', 'emulate_tty', 'cached_output'}


class LaunchError(Exception):
    """What ``ros2 launch`` would refuse."""


@dataclass
class Context:
    """Values of the arguments, and where the package is."""

    configurations: dict[str, str]
    share: Path


def perform(value: Any, context: Context) -> str:
    """Return the text of a substitution, or of several in a row."""
    if isinstance(value, str):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (list, tuple)):
        return ''.join(perform(part, context) for part in value)
    return str(value.perform(context))


def truth(text: str) -> bool:
    """Return what a condition makes of a text."""
    if text.strip().lower() in ('true', '1'):
        return True
    if text.strip().lower() in ('false', '0'):
        return False
    raise LaunchError(f'{text!r} is no condition')


class LaunchDescription:
    def __init__(
            self, initial_entities: Sequence[Any] | None = None, *,
            deprecated_reason: str | None = None) -> None:
        self.entities = list(initial_entities or [])


class LaunchConfiguration:
    def __init__(self, variable_name: Any, *, default: Any = None) -> None:
        self.name = variable_name
        self.default = default

    def perform(self, context: Context) -> str:
        if self.name in context.configurations:
            return context.configurations[self.name]
        if self.default is None:
            raise LaunchError(f'launch configuration {self.name} does not exist')
        return perform(self.default, context)


class PathJoinSubstitution:
    def __init__(self, substitutions: Sequence[Any]) -> None:
        self.parts = list(substitutions)

    def perform(self, context: Context) -> str:
        return str(Path(*(perform(part, context) for part in self.parts)))


class FindPackageShare:
    def __init__(self, package: Any) -> None:
        self.package = package

    def perform(self, context: Context) -> str:
        if perform(self.package, context) != 'hmsa_ros':
            raise LaunchError(f'package {self.package!r} not found')
        return str(context.share)


class IfCondition:
    def __init__(self, predicate_expression: Any) -> None:
        self.expression = predicate_expression

    def evaluate(self, context: Context) -> bool:
        return truth(perform(self.expression, context))


class DeclareLaunchArgument:
    def __init__(
            self, name: str, *, default_value: Any = None, description: str | None = None,
            choices: Sequence[str] | None = None, **kwargs: Any) -> None:
        _known(kwargs, _ACTION)
        self.name = name
        self.default_value = default_value
        self.description = description
        self.choices = choices


class Shutdown:
    def __init__(self, *, reason: Any = 'reason not given', **kwargs: Any) -> None:
        _known(kwargs, _ACTION)
        self.reason = reason


class ParameterValue:
    def __init__(self, value: Any, *, value_type: Any = None) -> None:
        self.value = value
        self.value_type = value_type

    def evaluate(self, context: Context) -> Any:
        text = perform(self.value, context)
        if self.value_type is str:
            return text
        value = yaml.safe_load(text)
        if self.value_type is not None and type(value) is not self.value_type:
            raise LaunchError(f'{text!r} is no {self.value_type.__name__}')
        return value


class Node:
    def __init__(
            self, *, executable: Any, package: Any = None, name: Any = None,
            namespace: Any = None, exec_name: Any = None,
            parameters: Sequence[Any] | None = None,
            remappings: Sequence[Any] | None = None,
            ros_arguments: Sequence[Any] | None = None,
            arguments: Sequence[Any] | None = None, **kwargs: Any) -> None:
        _known(kwargs, _PROCESS)
        self.executable, self.package, self.name = executable, package, name
        self.namespace = namespace
        self.parameters = list(parameters or [])
        self.ros_arguments, self.arguments = ros_arguments or [], arguments or []
        self.condition = kwargs.get('condition')
        self.on_exit = kwargs.get('on_exit')


def _known(given: Mapping[str, Any], known: set[str]) -> None:
    if set(given) - known:
        raise LaunchError(f'unexpected keywords {sorted(set(given) - known)}')


MODULES: dict[str, tuple[type, ...]] = {
    'launch': (LaunchDescription,),
    'launch.actions': (DeclareLaunchArgument, Shutdown),
    'launch.conditions': (IfCondition,),
    'launch.substitutions': (LaunchConfiguration, PathJoinSubstitution),
    'launch_ros': (),
    'launch_ros.actions': (Node,),
    'launch_ros.parameter_descriptions': (ParameterValue,),
    'launch_ros.substitutions': (FindPackageShare,),
}


@contextmanager
def _installed() -> Iterator[None]:
    """Have the names above imported from here."""
    before = {name: sys.modules.get(name) for name in MODULES}
    for name, contents in MODULES.items():
        module = ModuleType(name)
        for entry in contents:
            setattr(module, entry.__name__, entry)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, module_before in before.items():
            if module_before is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module_before


def description(path: Path) -> LaunchDescription:
    """Return what a launch file describes."""
    spec = importlib.util.spec_from_file_location(path.name.replace('.', '_'), path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with _installed():
        spec.loader.exec_module(module)
        described: LaunchDescription = module.generate_launch_description()
    return described


@dataclass
class Started:
    """
    A process that ``ros2 launch`` would start.

    Attributes
    ----------
    package, executable : str
        As for ``ros2 run``.
    arguments : list of str
        After the executable.
    parameters : dict of str to object
        Set by the launch file itself.
    files : list of str
        Parameter files, before those parameters.
    ends_all : bool
        Whether its end ends the launch.

    """

    package: str
    executable: str
    arguments: list[str] = field(default_factory=list)
    parameters: dict[str, Any] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)
    ends_all: bool = False


def evaluate(path: Path, arguments: Mapping[str, str], folder: Path) -> list[Started]:
    """
    Return what ``ros2 launch`` would start.

    Parameters
    ----------
    path : path
        Launch file.
    arguments : mapping of str to str
        As in ``name:=value``.
    folder : path
        Where the files of parameters are written.

    Returns
    -------
    list of Started
        In order.

    Raises
    ------
    LaunchError
        If ``ros2 launch`` would refuse.

    """
    context = Context(dict(arguments), path.parent.parent)
    started = []
    for entity in description(path).entities:
        if isinstance(entity, DeclareLaunchArgument):
            if entity.name not in context.configurations:
                if entity.default_value is None:
                    raise LaunchError(f'required launch argument {entity.name} was not given')
                context.configurations[entity.name] = perform(entity.default_value, context)
            value = context.configurations[entity.name]
            if entity.choices is not None and value not in entity.choices:
                raise LaunchError(f'{value!r} is no valid choice for {entity.name}')
        elif isinstance(entity, Node) and (
                entity.condition is None or entity.condition.evaluate(context)):
            started.append(_process(entity, context, folder / str(len(started))))
    return started


def _process(node: Node, context: Context, stem: Path) -> Started:
    name = perform(node.name, context)
    namespace = '/' + perform(node.namespace, context).lstrip('/')
    process = Started(
        perform(node.package, context), perform(node.executable, context),
        ends_all=isinstance(node.on_exit, Shutdown))
    process.arguments = [
        *(perform(part, context) for part in node.arguments),
        '--ros-args', *(perform(part, context) for part in node.ros_arguments),
        '--ros-args', '-r', f'__node:={name}', '-r', f'__ns:={namespace}']
    for entry in node.parameters:
        if isinstance(entry, dict):
            values = {key: value.evaluate(context) if isinstance(value, ParameterValue)
                      else value for key, value in entry.items()}
            process.parameters.update(values)
            # Under the node's full name, which comes before every wildcard.
            full_name = f'{namespace.rstrip("/")}/{name}'
            file = stem.with_suffix('.yaml')
            file.write_text(yaml.safe_dump({full_name: {'ros__parameters': values}}))
            process.arguments += ['--params-file', str(file)]
        else:
            process.files.append(perform(entry, context))
            process.arguments += ['--params-file', process.files[-1]]
    return process
