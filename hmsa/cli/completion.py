"""
Print a shell completion script.

Print a script that lets the shell complete commands, options and files. In ~/.bashrc or ~/.zshrc:
eval "$(hmsa completion bash)", or zsh. For fish: hmsa completion fish >
~/.config/fish/completions/hmsa.fish

example: hmsa completion bash
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hmsa.cli.options import add_command

# Options for a shaper, whose values are not checked by the parser.
_OF_SHAPERS = ('--shaper', '--shapers')
_FILES = ('FILE', 'FILE.csv', 'BAG')
_FOLDERS = ('DIR',)


@dataclass(frozen=True)
class Option:
    """An option."""

    names: tuple[str, ...]  # short and long
    text: str
    value: str = ''  # '' for none, 'file', 'folder', 'any', or 'one' of the choices
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Command:
    """A command, or the program itself."""

    path: str  # its words without the program's name
    options: tuple[Option, ...]
    # Commands or choices of its positional arguments, with their descriptions.
    words: dict[str, str]
    files: bool  # whether positional arguments are files

    @property
    def offered(self) -> dict[str, str]:
        """Words and options with their descriptions."""
        return {**self.words, **{x: option.text for option in self.options for x in option.names}}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('shell', None, str, 'the shell', {'choices': ('bash', 'zsh', 'fish')}))


def run(arguments: argparse.Namespace) -> int:
    """Print the script, from the template for the shell beside this file."""
    import jinja2  # only needed by this command

    from hmsa.cli import build_parser

    commands = list(commands_of(build_parser()))
    scripts = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), trim_blocks=True,
        keep_trailing_newline=True)
    scripts.filters['quote'] = _quote
    print(scripts.get_template(f'completion.{arguments.shell}').render(
        commands=commands, paths=[_quote(x.path) for x in commands if x.path]), end='')
    return 0


def commands_of(parser: argparse.ArgumentParser, path: str = '') -> Iterator[Command]:
    """Yield a parser and its subparsers as commands, outer ones first."""
    options: list[Option] = []
    words: dict[str, str] = {}
    inner: dict[str, argparse.ArgumentParser] = {}
    files = False
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            words |= {x.dest: x.help or '' for x in action._choices_actions}
            inner |= action.choices
        elif action.option_strings:
            options.append(_option(action))
        else:
            files = files or action.metavar in _FILES
            words |= {str(x): '' for x in action.choices or ()}
    if parser.usage and '--ros-args' in parser.usage:
        options.append(Option(('--ros-args',), 'what follows is for ROS'))
    yield Command(path, tuple(options), words, files)
    for name, each in inner.items():
        yield from commands_of(each, f'{path} {name}'.strip())


def _option(action: argparse.Action) -> Option:
    names = tuple(action.option_strings)
    text = ' '.join(((action.help or '') % vars(action)).split())
    choices = tuple(map(str, action.choices or ()))
    if names[-1] in _OF_SHAPERS:
        from hmsa.planning.shapers import SHAPERS  # imports NumPy

        choices = tuple(SHAPERS)
    return Option(names, text, (
        '' if action.nargs == 0 else 'one' if choices else 'file' if action.metavar in _FILES
        else 'folder' if action.metavar in _FOLDERS else 'any'), choices)


def _quote(text: str) -> str:
    """Return a text in single quotes that all three shells accept."""
    return "'" + text.replace("'", '’') + "'"
