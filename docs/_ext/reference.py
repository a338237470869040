"""
Reference pages made from the package while the documentation is built.

Each directive asks the package itself, so that a topic, parameter, code, message or option is
written down once, beside what uses it, and whatever is added there appears here.
"""

from abc import ABC, abstractmethod
import argparse
import ast
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
import html
from importlib import import_module
import inspect
from pathlib import Path
import pkgutil
import re
from typing import Any

from codes import EXPLANATIONS
from docutils import nodes
from docutils.parsers.rst import directives
from numpydoc.docscrape import get_doc_object
from numpydoc.validate import validate
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from hmsa import errors
from hmsa.cli import build_parser
from hmsa.interfaces import topics
from hmsa.model.status import Code
from hmsa.plugins import NODES, registered

LOGGER = logging.getLogger(__name__)
PACKAGES = Path(errors.__file__).parent.parent
# Functions that raise `BadInputError` about what they are told first.
CHECKS = (errors.check_choice.__name__, errors.check_number.__name__)
# Rules of numpydoc that the style of this project does not share: sections that not every
# function needs (ES01, EX01, SA01), the empty line before the closing quotes (GL02, GL03),
# parameters of one type described together (PR03), symbols that begin a description (PR08,
# RT04), results with a name (RT02).
IGNORED = frozenset({'ES01', 'EX01', 'SA01', 'GL02', 'GL03', 'PR03', 'PR08', 'RT04', 'RT02'})
# Modules without anything to call from outside; ros_launch is imported by ROS 2's launch alone.
NOT_PUBLIC = re.compile(r'\.(_\w+|cli|law|ros_launch)\b')


def declared(kind: type) -> list[Any]:
    """Return what `interfaces.topics` declares of a kind (Topic, Service), in its order."""
    return [x for x in vars(topics).values() if isinstance(x, kind)]


def parameters(node: str) -> tuple[Any, ...]:
    """Return the parameters that a node declares."""
    found: tuple[Any, ...] = registered(NODES)[node].load().PARAMETERS
    return found


def messages(path: Path) -> Iterator[tuple[str, str, int]]:
    """Yield class, sentence and line of the errors that a module raises."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    for node in ast.walk(tree):
        # Raised here or returned for a caller to raise.
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
            continue
        if node.func.id in CHECKS:
            what = node.args[0]
            name = placeholder(what) if isinstance(what, ast.Name) else sentence(what)
            yield 'BadInputError', f'{name} is {{…}}: expected {{…}}', node.lineno
        if node.func.id not in KINDS:
            continue
        texts = [text for text in map(sentence, node.args) if ' ' in text]
        if texts:
            yield node.func.id, texts[-1], node.lineno


def sentence(expression: ast.expr) -> str:
    """Return a text with ``{...}`` for each value that is only known later, or for all of it."""
    if isinstance(expression, ast.Constant) and isinstance(expression.value, str):
        return expression.value
    if isinstance(expression, ast.JoinedStr):
        return ''.join(
            str(part.value) if isinstance(part, ast.Constant) else placeholder(part)
            for part in expression.values)
    if isinstance(expression, ast.BinOp) and isinstance(expression.op, ast.Add):
        return sentence(expression.left) + sentence(expression.right)
    return '{…}'


def placeholder(part: ast.expr) -> str:
    """Return what stands in a sentence for a value: its last name in braces, or an ellipsis."""
    value = part.value if isinstance(part, ast.FormattedValue) else part
    if (isinstance(value, ast.Call) and isinstance(value.func, ast.Name)
            and value.func.id == errors.excerpt.__name__):
        value = value.args[0]
    if isinstance(value, ast.Name | ast.Attribute):
        name = value.id if isinstance(value, ast.Name) else value.attr
        return '{' + name.strip('_') + '}'
    return '{…}'


def kinds() -> dict[str, type[errors.HmsaError]]:
    """Return all classes of errors by name."""
    found: dict[str, type[errors.HmsaError]] = {}
    pending: list[type[errors.HmsaError]] = [errors.HmsaError]
    while pending:
        kind = pending.pop(0)
        found[kind.__name__] = kind
        pending += kind.__subclasses__()
    return found


def public_modules(package: str) -> list[str]:
    """Return the dotted names of a package's public modules, the package first."""
    module = import_module(package)
    inside = [
        x.name for x in pkgutil.walk_packages(getattr(module, '__path__', []), package + '.')]
    return [package, *(name for name in inside if not NOT_PUBLIC.search(name))]


def public_members(module: str) -> Iterator[tuple[str, Any]]:
    """Yield dotted name and thing of the classes, functions and methods of a module for others."""
    for name, thing in vars(import_module(module)).items():
        if name.startswith('_') or getattr(thing, '__module__', None) != module \
                or not (inspect.isclass(thing) or inspect.isroutine(thing)):
            continue
        yield f'{module}.{name}', thing
        if inspect.isclass(thing):
            for below, member in vars(thing).items():
                if not below.startswith('_') and inspect.isfunction(member) \
                        and member.__module__ == module and member.__name__ != '<lambda>':
                    yield f'{module}.{name}.{below}', member


def described_data(module: str) -> list[str]:
    """Return the constants of a module that a comment of the form ``#: ...`` describes."""
    source = inspect.getsource(import_module(module))
    return re.findall(r'^(?:#: .*\n)+([A-Z][A-Z0-9_]*)\b', source, re.M)


def faults(name: str, thing: Any) -> list[str]:
    """Return what a docstring lacks by numpydoc's rules and those of this project."""
    text = inspect.getdoc(thing) or ''
    ignored = IGNORED
    found = []
    if inspect.isclass(thing):
        # What its fields are stands under Attributes, what an error takes in its __init__.
        ignored = ignored | {'PR01'}
        if is_dataclass(thing):
            documented = {
                part.strip() for line in get_doc_object(thing)['Attributes']
                for part in line.name.split(',')}
            found = [f'field {x.name} is not under Attributes' for x in fields(thing)
                     if x.name in vars(thing)['__annotations__'] and '\nAttributes\n-' in text
                     and not x.name.startswith('_') and x.name not in documented]
    if not re.search(r'^(Parameters|Returns|Yields)\n-', text, re.M):
        # Words that say it all but what is raised.
        ignored = ignored | {'PR01', 'RT01', 'YD01'}
    return found + [
        f'{code} {reason}' for code, reason in validate(name)['errors'] if code not in ignored]


def subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the commands below a command by name, empty for none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown of titles and cells, with an empty line before and after."""
    head = list(head)
    lines = [head, ['---'] * len(head), *rows]
    return '\n' + '\n'.join(
        '| ' + ' | '.join(cell.replace('|', '\\|').replace('\n', ' ') for cell in line) + ' |'
        for line in lines) + '\n'


def qos_text(qos: topics.Quality) -> str:
    """Return reliability, durability if it is not volatile, and depth in words."""
    words = ['reliable' if qos.reliable else 'best effort']
    if qos.latched:
        words.append('transient local')
    return ', '.join([*words, f'depth {qos.depth}'])


class Generated(SphinxDirective, ABC):
    """A directive whose content is Markdown that `markdown` returns."""

    optional_arguments = 1
    final_argument_whitespace = True
    option_spec = {'level': directives.positive_int}

    def run(self) -> list[nodes.Node]:
        """Parse the Markdown where the directive stands."""
        # What is documented is the package: any change in it may change this page.
        self.env.note_reread()
        text = self.markdown(self.arguments[0] if self.arguments else '')
        return self.parse_text_to_nodes(text, allow_section_headings=True)

    @abstractmethod
    def markdown(self, argument: str) -> str:
        """Return the content."""

    def missing(self, what: str) -> None:
        """Warn of a hole in what the package says of itself; warnings fail the build."""
        LOGGER.warning('%s', what, location=self.get_location())


class Topics(Generated):
    """All topics."""

    def markdown(self, argument: str) -> str:
        """Return a table of all topics (see `Generated.markdown`)."""
        rows = []
        for topic in declared(topics.Topic):
            if not topic.meaning or not (topic.publishers or topic.subscribers):
                self.missing(
                    f'topic {topic.name} in hmsa.interfaces.topics has no meaning, or no '
                    'publishers and subscribers: expected both beside its name')
            rows.append((
                f'`{topic.name}`',
                f'{topic.meaning}<br>*From {" and ".join(topic.publishers) or "you"} to '
                f'{" and ".join(topic.subscribers) or "you"}: `{topic.type}`, '
                f'{qos_text(topic.qos)}.*'))
        return table(('name', 'meaning'), rows)


class Services(Generated):
    """All services, by node."""

    def markdown(self, argument: str) -> str:
        """Return a table of all services (see `Generated.markdown`)."""
        services = declared(topics.Service)
        for service in services:
            if not service.meaning:
                self.missing(
                    f'service {service.name} in hmsa.interfaces.topics has no meaning: '
                    'expected one for each node that serves it')
        return table(
            ('node', 'name', 'meaning'),
            ((node, f'`{service.name}`',
              f'{service.meaning[node]}<br>*`{service.type}`*')
             for node in topics.NODES for service in services if node in service.meaning))


class Actions(Generated):
    """All actions, and the topics of their states."""

    def markdown(self, argument: str) -> str:
        """Return a table of all actions (see `Generated.markdown`)."""
        return table(('node', 'name', 'meaning'), (
            (x.server, f'`{y.name}`', f'{y.meaning}<br>*`{y.type}`*')
            for x in declared(topics.Action) for y in (x, x.state)))


class Parameters(Generated):
    """The parameters of one node."""

    def markdown(self, argument: str) -> str:
        """Return a table of the parameters of a node (see `Generated.markdown`)."""
        rows = []
        for spec in parameters(argument):
            # Ranges that only keep nonsense out (from, to in powers of ten) are shown, too:
            # they are what a value is held against.
            limits = ', '.join(f'`{choice}`' for choice in spec.choices) or spec.range_text()
            default = spec.default
            if isinstance(default, float):
                shown = f'{default:.6g}'
            elif isinstance(default, str):
                shown = f"'{default}'"
            elif isinstance(default, list):
                shown = '[' + ', '.join(map(str, default)) + ']'
            else:
                shown = str(default).lower()
            details = [
                type(default).__name__ if not isinstance(default, list)
                else f'list of {spec.items.__name__}',
                *([] if limits == 'any value' else [limits]),
                *([] if spec.read_only else ['can be set while running'])]
            rows.append((
                f'`{spec.name}`',
                f'{spec.description}<br>*Default `{shown}`'
                + (f' {spec.unit}' if spec.unit else '') + f'; {"; ".join(details)}.*'))
        return table(('name', 'meaning'), rows)


class Codes(Generated):
    """The codes of verdicts."""

    def markdown(self, argument: str) -> str:
        """Return a table of all codes (see `Generated.markdown`)."""
        for code in Code:
            if code not in EXPLANATIONS:
                self.missing(
                    f'code {code} in hmsa.model.status is not explained: expected an entry '
                    'in docs/_ext/codes.py')
        return table(
            ('code', 'meaning', 'what to do'),
            ((f'`{code}`', *EXPLANATIONS[code]) for code in Code if code in EXPLANATIONS))


class ErrorKinds(Generated):
    """The classes of errors."""

    def markdown(self, argument: str) -> str:
        """Return a table of the classes (see `Generated.markdown`)."""
        return table(
            ('class', 'is a', 'exit status', 'meaning'),
            ((f'`{kind.__module__}.{name}`', ', '.join(f'`{x.__name__}`' for x in kind.__bases__),
              '2' if issubclass(kind, errors.BadInputError) else '1',
              (kind.__doc__ or '').strip().partition('\n')[0])
             for name, kind in KINDS.items()))


class ErrorMessages(Generated):
    """The sentences of all errors raised in a part of the package."""

    def markdown(self, argument: str) -> str:
        """Return a list of the sentences, without repetition (see `Generated.markdown`)."""
        found: dict[str, str] = {}
        for part in argument.split():
            place = PACKAGES / part.replace('.', '/')
            for path in sorted(place.rglob('*.py')) if place.is_dir() else [place]:
                for _, text, _ in messages(path):
                    found.setdefault(' '.join(text.split()), path.name)
        return '\n' + '\n'.join(
            '* <code>' + html.escape(text).replace('*', '&#42;').replace('_', '&#95;')
            + '</code>' for text in sorted(found, key=str.lower)) + '\n'


class CommandLine(Generated):
    """Help of each command."""

    def markdown(self, argument: str) -> str:
        """Return a section a command (see `Generated.markdown`)."""
        return ''.join(self._sections('hmsa', build_parser(), 2))

    def _sections(
            self, name: str, parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
        """Walk a command and the commands below it."""
        # The width of a help text follows the terminal's, of which a build has none.
        parser.formatter_class = _Formatter
        yield f'\n{"#" * level} `{name}`\n\n```text\n{parser.format_help()}```\n'
        for below, child in subparsers(parser).items():
            yield from self._sections(f'{name} {below}', child, min(level + 1, 3))


class _Formatter(argparse.HelpFormatter):
    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **{**keywords, 'width': 88})


class Api(Generated):
    """Public modules of a package by autodoc, their docstrings validated by numpydoc."""

    def markdown(self, argument: str) -> str:
        """Return a section a module (see `Generated.markdown`)."""
        sections = []
        for module in (name for part in argument.split() for name in public_modules(part)):
            lines = [f'.. automodule:: {module}']
            lines += [f'.. autodata:: {module}.{name}' for name in described_data(module)]
            for name, thing in public_members(module):
                for fault in faults(name, thing):
                    self.missing(f'docstring of {name}: {fault}')
                if inspect.isclass(thing):
                    # Matplotlib gives subclasses of its artists a method `set` of its own.
                    foreign = ', '.join(
                        x for x, member in vars(thing).items() if inspect.isfunction(member)
                        and not x.startswith('_') and member.__module__ != module)
                    lines += [f'.. autoclass:: {name}\n   :members:'
                              + (f'\n   :exclude-members: {foreign}' if foreign else '')]
                elif inspect.isroutine(thing) and name.rpartition('.')[0] == module:
                    lines += [f'.. autofunction:: {name}']
            sections.append(
                f'\n## `{module}`\n\n```{{eval-rst}}\n' + '\n\n'.join(lines) + '\n```\n')
        return ''.join(sections)


KINDS = kinds()
DIRECTIVES = {
    'hmsa-topics': Topics, 'hmsa-services': Services, 'hmsa-actions': Actions,
    'hmsa-parameters': Parameters,
    'hmsa-codes': Codes, 'hmsa-error-kinds': ErrorKinds, 'hmsa-error-messages': ErrorMessages,
    'hmsa-commands': CommandLine, 'hmsa-api': Api}


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    for name, directive in DIRECTIVES.items():
        app.add_directive(name, directive)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
