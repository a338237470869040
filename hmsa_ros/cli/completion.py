"""
``hmsa completion``: scripts by which a shell completes commands and options.

They hold everything that they need, so that no key press starts Python.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
import re
from typing import Any

# Options whose values are checked later than by the parser, those of a shaper.
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

    path: str  # its words without the program's name, with spaces between
    text: str
    options: tuple[Option, ...]
    # Commands or choices that its positional arguments may be, and what they mean.
    words: dict[str, str] = field(default_factory=dict)
    files: bool = False  # whether positional arguments are files


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'completion', help='print a shell completion script',
        description='Print a script that lets the shell complete commands, options and files. '
                    'In ~/.bashrc or ~/.zshrc: eval "$(hmsa completion bash)", or zsh. For '
                    'fish: hmsa completion fish > ~/.config/fish/completions/hmsa.fish',
        epilog='example: hmsa completion bash')
    parser.add_argument('shell', choices=tuple(_SCRIPTS), help='the shell')


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    from hmsa_ros.cli import build_parser

    commands = list(commands_of(build_parser()))
    fill, between = _SCRIPTS[arguments.shell]
    text = Path(__file__).with_suffix(f'.{arguments.shell}').read_text(encoding='utf-8')
    text = text.replace('@paths@', between.join(_quote(x.path) for x in commands if x.path))
    for name, lines in fill(commands).items():
        text = text.replace(f'@{name}@', '\n'.join(lines))
    print(text, end='')
    return 0


def commands_of(parser: argparse.ArgumentParser, path: str = '', text: str = '') \
        -> Iterator[Command]:
    """Yield a parser and its subparsers as commands, the outer ones first."""
    options: list[Option] = []
    words: dict[str, str] = {}
    files = False
    inner: list[tuple[argparse.ArgumentParser, str, str]] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            texts = {x.dest: x.help or '' for x in action._choices_actions}
            for name, each in action.choices.items():
                words[name] = texts.get(name, '')
                inner.append((each, f'{path} {name}'.strip(), words[name]))
        elif action.option_strings:
            options.append(_option(action))
        else:
            files = files or action.metavar in _FILES
            words |= {str(x): '' for x in action.choices or ()}
    if parser.usage and '--ros-args' in parser.usage:
        options.append(Option(('--ros-args',), 'what follows is for ROS'))
    yield Command(path, text, tuple(options), words, files)
    for arguments in inner:
        yield from commands_of(*arguments)


def _option(action: argparse.Action) -> Option:
    names = tuple(action.option_strings)
    text = re.sub(r'\s+', ' ', (action.help or '') % vars(action)) if action.help else ''
    if action.nargs == 0:
        return Option(names, text)
    choices = tuple(map(str, action.choices or ()))
    if names[-1] in _OF_SHAPERS:
        from hmsa_ros.planning.shapers import SHAPERS  # imports NumPy, which not all commands need

        choices = tuple(SHAPERS)
    kind = ('one' if choices else 'file' if action.metavar in _FILES
            else 'folder' if action.metavar in _FOLDERS else 'any')
    return Option(names, text, kind, choices)


def _quote(text: str) -> str:
    """Return a text in single quotes, as all three shells read it."""
    return "'" + text.replace("'", '’') + "'"


def _valued(commands: list[Command]) -> Iterator[tuple[str, Option]]:
    """Walk the options that take a value, each with its cases for bash and zsh."""
    for command in commands:
        for option in command.options:
            if option.value:
                yield ' | '.join(_quote(f'{command.path}:{x}') for x in option.names), option


# bash ----------------------------------------------------------------------------------------

def _bash(commands: list[Command]) -> dict[str, list[str]]:
    """Return what fills the script for bash."""
    words = []
    for command in commands:
        names = [*command.words, *(y for x in command.options for y in x.names)]
        also = '_hmsa_files -f; ' if command.files else ''
        words.append(f'    {_quote(command.path)}) {also}_hmsa_words {" ".join(names)} ;;')
    return {'words': words, 'values': [
        f'    {keys}) {_bash_value(x)}; return ;;' for keys, x in _valued(commands)]}


def _bash_value(option: Option) -> str:
    return {
        'one': f'_hmsa_words {" ".join(option.choices)}', 'file': '_hmsa_files -f',
        'folder': '_hmsa_files -d', 'any': ':'}[option.value]


# zsh -----------------------------------------------------------------------------------------

def _zsh(commands: list[Command]) -> dict[str, list[str]]:
    """Return what fills the script for zsh."""
    words = []
    for command in commands:
        also = '; _files' if command.files else ''
        words.append(
            f'    ({_quote(command.path)}) _hmsa_offer {_zsh_pairs(command)}{also} ;;')
    return {'words': words, 'values': [
        f'    ({keys}) {_zsh_value(x)}; return ;;' for keys, x in _valued(commands)]}


def _zsh_value(option: Option) -> str:
    return {
        'one': f'compadd -- {" ".join(option.choices)}', 'file': '_files',
        'folder': '_files -/', 'any': "_message 'value'"}[option.value]


def _zsh_pairs(command: Command) -> str:
    pairs = [*command.words.items(), *(
        (name, option.text) for option in command.options for name in option.names)]
    return ' '.join(
        _quote(f'{name}:{text.replace(":", chr(92) + ":")}' if text else name)
        for name, text in pairs)


# fish ----------------------------------------------------------------------------------------

def _fish(commands: list[Command]) -> dict[str, list[str]]:
    """Return what fills the script for fish."""
    lines = []
    for command in commands:
        begin = f'complete -c hmsa -n {_quote(f"__hmsa_at {chr(34)}{command.path}{chr(34)}")}'
        for word, text in command.words.items():
            lines.append(f'{begin} -a {word} -d {_quote(text)}')
        if command.files:
            lines.append(f'{begin} -F')
        for option in command.options:
            names = ' '.join(
                f'-l {x[2:]}' if x.startswith('--') else f'-s {x[1:]}' for x in option.names)
            value = {
                '': '', 'any': ' -x', 'file': ' -r -F',
                'folder': " -x -a '(__fish_complete_directories)'",
                'one': f' -x -a {_quote(" ".join(option.choices))}'}[option.value]
            lines.append(f'{begin} {names}{value} -d {_quote(option.text)}')
    return {'words': lines}


# What fills the script of each shell, which lies beside this file, and joins its paths.
_SCRIPTS = {'bash': (_bash, ' | '), 'zsh': (_zsh, ' | '), 'fish': (_fish, ' ')}
