"""
``hmsa completion``: scripts by which a shell completes commands and options.

They hold everything that they need, so that no key press starts Python.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
import re
from typing import Any

#: What follows ``--ros-args``.
ROS_ARGUMENTS = {
    '-p': 'set a parameter, NAME:=VALUE', '-r': 'remap a name, FROM:=TO',
    '--params-file': 'file with parameters', '--log-level': 'lowest severity to log',
    '--enclave': 'security enclave', '--disable-rosout-logs': 'do not publish the log'}
_ROS_FILES = ('--params-file',)
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

    print(_SCRIPTS[arguments.shell](list(commands_of(build_parser()))), end='')
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

def _bash(commands: list[Command]) -> str:
    """Return the script for bash."""
    paths = ' | '.join(_quote(x.path) for x in commands if x.path)
    values = [f'    {keys}) {_bash_value(x)}; return ;;' for keys, x in _valued(commands)]
    values += [f"    '--ros-args:{x}') _hmsa_files -f; return ;;" for x in _ROS_FILES]
    values.append("    --ros-args:-[pr] | '--ros-args:--log-level') return ;;")
    words = []
    for command in commands:
        names = [*command.words, *(y for x in command.options for y in x.names)]
        also = '_hmsa_files -f; ' if command.files else ''
        words.append(f'    {_quote(command.path)}) {also}_hmsa_words {" ".join(names)} ;;')
    words.append(f"    '--ros-args') _hmsa_words {' '.join(ROS_ARGUMENTS)} ;;")
    return '\n'.join([
        '# Completion of hmsa for bash: eval "$(hmsa completion bash)"',
        '_hmsa_words() {', '  local each',
        '  while IFS= read -r each; do COMPREPLY+=("$each"); done \\',
        '    < <(compgen -W "$*" -- "$cur")', '}',
        '_hmsa_files() {', '  local each', '  compopt -o filenames 2> /dev/null',
        '  while IFS= read -r each; do COMPREPLY+=("$each"); done < <(compgen "$1" -- "$cur")',
        '}',
        '_hmsa() {',
        '  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD-1]}',
        "  local at='' word i", '  COMPREPLY=()',
        '  for ((i = 1; i < COMP_CWORD; i++)); do', '    word=${COMP_WORDS[i]}',
        "    if [[ $word == --ros-args ]]; then at='--ros-args'; break; fi",
        '    case "${at:+$at }$word" in', f'      {paths}) at="${{at:+$at }}$word" ;;',
        '    esac', '  done',
        '  case "$at:$prev" in', *values, '  esac',
        '  case "$at" in', *words, '  esac', '}',
        'complete -F _hmsa hmsa', ''])


def _bash_value(option: Option) -> str:
    return {
        'one': f'_hmsa_words {" ".join(option.choices)}', 'file': '_hmsa_files -f',
        'folder': '_hmsa_files -d', 'any': ':'}[option.value]


# zsh -----------------------------------------------------------------------------------------

def _zsh(commands: list[Command]) -> str:
    """Return the script for zsh."""
    paths = ' | '.join(_quote(x.path) for x in commands if x.path)
    values = [f'    ({keys}) {_zsh_value(x)}; return ;;' for keys, x in _valued(commands)]
    values += [f"    ('--ros-args:{x}') _files; return ;;" for x in _ROS_FILES]
    words = []
    for command in commands:
        also = '; _files' if command.files else ''
        words.append(
            f'    ({_quote(command.path)}) _hmsa_offer {_zsh_pairs(command)}{also} ;;')
    pairs = ' '.join(_quote(f'{x}:{text}') for x, text in ROS_ARGUMENTS.items())
    words.append(f"    ('--ros-args') _hmsa_offer {pairs} ;;")
    return '\n'.join([
        '#compdef hmsa',
        '# Completion of hmsa for zsh: eval "$(hmsa completion zsh)" after compinit',
        '_hmsa_offer() {', '  local -a pairs=("$@")', "  _describe 'hmsa' pairs", '}',
        '_hmsa() {', "  local at='' word i",
        '  for ((i = 2; i < CURRENT; i++)); do', '    word=${words[i]}',
        "    if [[ $word == --ros-args ]]; then at='--ros-args'; break; fi",
        '    case "${at:+$at }$word" in', f'      ({paths}) at="${{at:+$at }}$word" ;;',
        '    esac', '  done',
        '  case "$at:${words[CURRENT-1]}" in', *values, '  esac',
        '  case "$at" in', *words, '  esac', '}',
        'if [[ $zsh_eval_context[-1] == loadautofunc ]]; then', '  _hmsa "$@"', 'else',
        '  compdef _hmsa hmsa', 'fi', ''])


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

def _fish(commands: list[Command]) -> str:
    """Return the script for fish."""
    paths = ' '.join(_quote(x.path) for x in commands if x.path)
    lines = [
        '# Completion of hmsa for fish: ~/.config/fish/completions/hmsa.fish',
        'function __hmsa_at', "  set -l at ''",
        '  for word in (commandline -opc)[2..-1]',
        '    if test "$word" = --ros-args', '      set at --ros-args', '      break', '    end',
        '    set -l next (string trim -- "$at $word")',
        f'    if contains -- "$next" {paths}', '      set at $next', '    end', '  end',
        '  test "$at" = "$argv[1]"', 'end', 'complete -c hmsa -f']
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
    for name, text in ROS_ARGUMENTS.items():
        files = ' -F' if name in _ROS_FILES else ''
        lines.append(
            f"complete -c hmsa -n '__hmsa_at \"--ros-args\"' -a {name} -d {_quote(text)}{files}")
    return '\n'.join([*lines, ''])


_SCRIPTS = {'bash': _bash, 'zsh': _zsh, 'fish': _fish}
