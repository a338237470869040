"""
Code blocks of the pages: found, run in order, or checked if they cannot run.

The info string of a block determines its treatment:

``bash``, ``console``, ``python``
    It runs. ``console`` shows commands after ``$`` and their output; a ``text`` block right after
    a block that runs shows its output. Words must be equal, numbers agree to 0.1 % or 1e-6, and
    ``...`` stands for anything.
``bash ros2-installation``
    It needs a full ROS 2 installation (the ros2 command, colcon, a desktop): its syntax and every
    name of this package in it are checked.
``bash repository``
    It sets up the clone, runs its gate or measures for minutes: its targets, extras, modules and
    files are checked.
``yaml``, ``json``
    It must be well formed, and its parameters must exist.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
import json
import math
import os
from pathlib import Path
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from typing import Any

from conftest import without_progress
from markdown_it import MarkdownIt
import yaml

ROOT = Path(__file__).resolve().parent.parent
RUN, INSTALLATION, REPOSITORY = '', 'ros2-installation', 'repository'
# Parts of the repository that commands in the pages name, copied to a page's directory.
SHOWN = ('README.md', 'benchmarks', 'config', 'docs', 'launch', 'package.xml', 'scripts')
# Directives of MyST whose content is Markdown again, and those without code to run.
NESTED = {'note', 'tip', 'warning', 'important', 'admonition', 'dropdown'}
NO_CODE = {'toctree', 'math', 'figure', 'image', 'literalinclude', 'contents'}
# Programs of a full installation whose arguments do not concern this package.
FOREIGN = {
    'apt', 'cd', 'colcon', 'export', 'foxglove-studio', 'git', 'mkdir', 'plotjuggler', 'rosdep',
    'rqt', 'rqt_graph', 'rqt_plot', 'rviz2', 'source', 'sudo', '.', 'pip', 'kill', 'wait',
    'unset', 'echo', 'cp', 'openssl', 'scp', 'ssh', 'systemctl', 'ulimit', 'chrt'}
KEYWORDS = {'do', 'done', 'else', 'fi', 'if', 'then', 'until', 'while'}
PATIENCE_SECONDS = 200.0
# Default lead time, unless a page sets one: long enough that a busy machine sends no late
# commands.
AHEAD = """\
case "$1" in planner|controller)
  name=$1
  shift
  set -- "$name" --ros-args -p lead_time:=2.0 "$@" ;;
esac
"""
NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?')
LARGEST_SHARE, LARGEST_DIFFERENCE = 1e-3, 1e-6


@dataclass(frozen=True)
class Block:
    """
    A code block of a page.

    Attributes
    ----------
    page : Path
        Its page.
    line : int
        Its first line, from 1.
    language, marker : str
        First word of the info string, and the rest.
    text : str
        Its content.
    follows : bool
        Whether it directly follows another block.

    """

    page: Path
    line: int
    language: str
    marker: str
    text: str
    follows: bool = False

    @property
    def runs(self) -> bool:
        """Whether it is run, not only checked."""
        return self.language in ('bash', 'console', 'python') and self.marker == RUN

    @property
    def place(self) -> str:
        """Return its location in the form used by editors."""
        return f'{self.page.relative_to(ROOT)}:{self.line}'


def pages() -> list[Path]:
    """Return all pages with prose: at the root and under docs/."""
    found = [*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')]
    return sorted(page for page in found if '_build' not in page.parts)


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page, in order."""
    return list(_blocks(page, page.read_text(encoding='utf-8'), 0))


def _blocks(page: Path, text: str, offset: int) -> Iterator[Block]:
    last = None
    for token in MarkdownIt('commonmark').parse(text):
        if token.type not in ('fence', 'code_block'):
            if token.type != 'html_block':
                last = None
            continue
        line = offset + token.map[0] + 1
        language, _, marker = token.info.strip().partition(' ')
        if language.startswith('{'):
            name = language.strip('{}')
            if name in NESTED:
                yield from _blocks(page, token.content, line)
            elif name not in NO_CODE and not name.startswith('hmsa-'):
                yield Block(page, line, language, marker, token.content)
            last = None
            continue
        language = {'sh': 'bash', 'shell': 'bash', 'py': 'python'}.get(language, language)
        found = Block(page, line, language, marker.strip(), token.content,
                      follows=last is not None)
        last = found
        yield found


def fault(block: Block, previous: Block | None) -> str:
    """Return why a block is neither run nor checked, empty if it is."""
    if block.language == '':
        return 'has no language: expected a fence with one, as in ```bash'
    if block.marker and (block.language != 'bash'
                         or block.marker not in (INSTALLATION, REPOSITORY)):
        return f'is marked {block.marker!r}: expected bash {INSTALLATION} or bash {REPOSITORY}'
    known = ('bash', 'console', 'python', 'text', 'yaml', 'json')
    if block.language not in known:
        return f'is in {block.language!r}: expected one of {", ".join(known)}'
    if block.language == 'text' and not block.follows and previous is not None \
            and re.match(r'\s*(\$|hmsa|ros2|make|python) ', block.text):
        return 'shows a command as text: expected bash'
    return ''


# -- blocks that run -----------------------------------------------------------------------------


class Failure(AssertionError):  # noqa: N818 - named for its meaning
    """A block whose behaviour differs from its page."""


PYTHON_LOOP = """
import contextlib, os, sys, traceback
names = {'__name__': '__main__'}
for line in sys.stdin:
    file, out, place = line.rstrip('\\n').split('\\t')
    status = 0
    with open(out, 'w') as log, contextlib.redirect_stdout(log), \\
            contextlib.redirect_stderr(log):
        try:
            with open(file) as source:
                code = source.read()
            exec(compile(code, place, 'exec'), names)
        except BaseException:
            traceback.print_exc()
            status = 1
    os.write(int(sys.argv[1]), f'{status}\\n'.encode())
"""
# Ends the processes that a page left running, and fails if one does not end cleanly.
TRAILER = """
set +e
jobs=$(jobs -p)
failed=0
for job in $jobs; do kill -TERM $job 2>/dev/null; done
for job in $jobs; do
  wait $job
  status=$?
  if [ $status -ne 0 ]; then echo "a background process ended with status $status"; failed=1; fi
done
(exit $failed)
"""


class Session:
    """
    A shell and a Python interpreter in one directory, which run the blocks of a page.

    Parameters
    ----------
    folder : Path
        Empty directory.
    environment : mapping of str to str
        Environment with a separate ROS domain.

    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        """Prepare the directory, without starting anything."""
        self._folder = folder / 'work'
        self._files = folder / 'blocks'
        tools = folder / 'bin'
        for directory in (self._folder, self._files, tools):
            directory.mkdir()
        for name in SHOWN:
            # A copy, since commands of a page may write as in a clone.
            if (ROOT / name).is_dir():
                shutil.copytree(
                    ROOT / name, self._folder / name,
                    ignore=shutil.ignore_patterns('_build', '__pycache__'))
            else:
                shutil.copy(ROOT / name, self._folder / name)
        # The package of this clone, regardless of the installed one.
        for name, words in (('hmsa', '-m hmsa_ros '), ('python', ''), ('python3', '')):
            (tools / name).write_text(
                f'#!/bin/sh\n{AHEAD if words else ""}exec {sys.executable} {words}"$@"\n')
            (tools / name).chmod(0o755)
        self._environment = {
            **environment, 'PATH': f'{tools}:{os.environ["PATH"]}', 'MPLBACKEND': 'Agg',
            'COLUMNS': '100'}
        self._read, self._write = os.pipe()
        self._shell: subprocess.Popen[str] | None = None
        self._python: subprocess.Popen[str] | None = None
        self._stuck = False
        self._count = 0

    def run(self, language: str, text: str, place: str) -> str:
        """Run a block, and return its output; raise `Failure` if it fails."""
        self._count += 1
        file = self._files / f'{self._count}.{"py" if language == "python" else "sh"}'
        out = file.with_suffix('.out')
        out.touch()
        if language == 'python':
            file.write_text(text, encoding='utf-8')
            if self._python is None:
                self._python = self._start(
                    [sys.executable, '-u', '-c', PYTHON_LOOP, str(self._write)])
            self._execute(self._python, f'{file}\t{out}\t{place}', place, out)
        else:
            file.write_text('set -eo pipefail\n' + text, encoding='utf-8')
            if self._shell is None:
                self._shell = self._start(['bash', '--noprofile', '--norc'])
                # If this process is killed, its end of the pipe closes, and the shell ends with
                # its child processes.
                self._execute(self._shell, "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT; "
                           f'echo 0 >&{self._write}', place, out)
            self._execute(
                self._shell,
                f'source {file} </dev/null >{out} 2>&1; echo $? >&{self._write}', place, out)
        return out.read_text(encoding='utf-8', errors='replace')

    def close(self) -> None:
        """End everything; raise `Failure` if something failed or was left running."""
        try:
            if self._shell is not None and self._shell.poll() is None and not self._stuck:
                self.run('bash', TRAILER, 'end of the page')
        finally:
            for process in (self._python, self._shell):
                if process is None:
                    continue
                assert process.stdin is not None
                process.stdin.close()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.0 if self._stuck else PATIENCE_SECONDS)
                # Any processes left.
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            os.close(self._read)
            os.close(self._write)

    def _start(self, words: list[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            words, cwd=self._folder, env=self._environment, stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True,
            pass_fds=[self._write], start_new_session=True)

    def _execute(self, process: subprocess.Popen[str], line: str, place: str, out: Path) -> None:
        """Execute a line, and wait for its status."""
        assert process.stdin is not None
        process.stdin.write(line + '\n')
        process.stdin.flush()
        end = time.monotonic() + PATIENCE_SECONDS
        status = ''
        while not status.endswith('\n'):
            if select.select([self._read], [], [], 0.05)[0]:
                status += os.read(self._read, 100).decode()
            elif process.poll() is not None:
                status = f'{process.returncode}\n'
            elif time.monotonic() > end:
                status = f'none within {PATIENCE_SECONDS:g} s\n'
                self._stuck = True
        if status != '0\n':
            raise Failure(
                f'{place}: status {status.strip()}, expected 0; it printed\n{self._printed()}')

    def _printed(self) -> str:
        """Return the output of all blocks so far, since background nodes print later."""
        return '\n'.join(
            f'[{file.stem}] {file.read_text(errors="replace")[-3000:]}'
            for file in sorted(self._files.glob('*.out'), key=lambda file: int(file.stem)))


def run_page(page: Path, folder: Path, environment: Mapping[str, str]) -> list[str]:
    """Run the blocks of a page, compare their output, and return a log with their times."""
    session = Session(folder, environment)
    printed: str | None = None
    log = []
    try:
        for block in blocks(page):
            if block.language == 'text' and block.follows and printed is not None:
                compare(block.text, printed, block.place)
            printed = None
            if not block.runs:
                continue
            began = time.monotonic()
            if block.language == 'console':
                for command, expected in console(block):
                    compare(expected, session.run('bash', command, block.place), block.place)
            else:
                printed = session.run(block.language, block.text, block.place)
            log.append(f'{block.place}: {block.language} ran in '
                       f'{time.monotonic() - began:.1f} s')
    except BaseException:
        with suppress(Failure):  # the first failure is reported
            session.close()
        raise
    session.close()
    return log


def console(block: Block) -> list[tuple[str, str]]:
    """Return the commands of a console block, each with its expected output."""
    parts = re.split(r'^\$ ', block.text, flags=re.M)
    if parts[0].strip():
        raise Failure(f'{block.place}: begins with output: expected $ and a command')
    found = []
    for part in parts[1:]:
        lines = part.splitlines()
        end = next(i for i, line in enumerate(lines) if not line.endswith('\\')) + 1
        found.append(('\n'.join(lines[:end]), '\n'.join(lines[end:])))
    return found


def compare(shown: str, printed: str, place: str) -> None:
    """Raise `Failure` unless the output agrees with the page."""
    if not alike(shown, without_progress(printed)):
        raise Failure(
            f'{place}: the page shows\n{shown}\nbut this was printed\n{printed}')


def alike(shown: str, printed: str) -> bool:
    """Whether two texts agree; ``...`` stands for any number of words."""
    return _alike(shown.split(), printed.split())


def _alike(shown: list[str], printed: list[str]) -> bool:
    if '...' not in shown:
        return len(shown) == len(printed) and all(map(same_word, shown, printed))
    before = shown.index('...')
    rest = shown[before + 1:]
    if len(printed) < before or not all(map(same_word, shown[:before], printed)):
        return False
    return any(_alike(rest, printed[i:]) for i in range(before, len(printed) + 1))


def same_word(shown: str, printed: str) -> bool:
    """Whether two words are equal, apart from the last digits of numbers."""
    if shown == printed:
        return True
    numbers = [float(x) for x in NUMBER.findall(shown)]
    others = [float(x) for x in NUMBER.findall(printed)]
    return NUMBER.sub('#', shown) == NUMBER.sub('#', printed) and all(
        math.isclose(a, b, rel_tol=LARGEST_SHARE, abs_tol=LARGEST_DIFFERENCE)
        for a, b in zip(numbers, others, strict=True))


# -- blocks that are only checked ----------------------------------------------------------------


def check(block: Block) -> None:
    """Raise `Failure` unless a block that does not run passes its checks."""
    try:
        if block.language == 'python':
            compile(block.text, block.place, 'exec')
        elif block.language == 'json':
            json.loads(block.text)
        elif block.language == 'yaml':
            _check_yaml(yaml.safe_load(block.text))
        elif block.language == 'bash':
            text = block.text
            found = subprocess.run(
                ['bash', '-n'], input=text, capture_output=True, text=True, check=False)
            if found.returncode:
                raise Failure(found.stderr)
            for words in commands(text):
                if block.marker == INSTALLATION:
                    _check_installed(words)
                elif block.marker == REPOSITORY:
                    _check_repository(words)
    except Failure as error:
        raise Failure(f'{block.place}: {error}') from None
    except (SyntaxError, ValueError, yaml.YAMLError) as error:
        raise Failure(f'{block.place}: {error}') from error


def commands(text: str) -> list[list[str]]:
    """Return the words of each simple command of a script, those in ``$(...)`` first."""
    found: list[list[str]] = []
    text = re.sub(r'\\\n', ' ', text)
    for inner in re.findall(r'\$\(([^()]*)\)', text):
        found += commands(inner)
    for line in re.sub(r'\$\([^()]*\)', 'SUBSTITUTED', text).splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars='();<>|&')
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ';']:
            if re.fullmatch(r'[();|&]+', word):
                while words and (words[0] in KEYWORDS or re.fullmatch(r'\w+=.*', words[0])):
                    words.pop(0)
                if words and words[0] != 'for':
                    found.append(words)
                words = []
            else:
                words.append(word)
    return found


def declared(node: str) -> dict[str, Any]:
    """Return the parameters of a node by name."""
    from hmsa.plugins import NODES, registered

    return {x.name: x for x in registered(NODES)[node].load().PARAMETERS}


def _nodes() -> tuple[str, ...]:
    from hmsa.interfaces import topics

    return topics.NODES


def _require(condition: object, sentence: str) -> None:
    if not condition:
        raise Failure(sentence)


def _check_yaml(document: Any) -> None:
    """Compare a parameter file with the parameters declared by the nodes."""
    if not isinstance(document, dict):
        return
    for pattern, entry in document.items():
        if not (isinstance(entry, dict) and 'ros__parameters' in entry):
            continue
        nodes = [x for x in _nodes() if x in str(pattern)] or _nodes()
        for name in _flat(entry['ros__parameters'], ''):
            _check_parameter(name, nodes)


def _flat(entry: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for name, value in entry.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield prefix + name


def _check_parameter(name: str, nodes: Iterable[str]) -> None:
    """Require that one of some nodes declares a parameter, for all joints or for one."""
    known = {'use_sim_time', 'autostart'}.union(*map(declared, nodes))
    short = name.partition('.')[2]
    _require(name in known or short in known,
             f'parameter {name!r} is not declared by {" or ".join(nodes)}')


def topics_by_name() -> dict[str, Any]:
    """Return the topics by their names from outside, for one joint without namespace."""
    from hmsa.interfaces import topics

    names = ((topics.from_outside(x.name, node), x) for x in vars(topics).values()
             if isinstance(x, topics.Topic) for node in (*x.publishers, *x.subscribers))
    return {name if name.startswith('/') else f'/{name}': topic for name, topic in names}


def services_by_name() -> dict[str, Any]:
    """Return the services by their names from outside, without a namespace."""
    from hmsa.interfaces import topics

    return {f'/{topics.from_outside(x.name, node)}': x for x in vars(topics).values()
            if isinstance(x, topics.Service) for node in x.meaning}


def _known_name(name: str, known: Iterable[str]) -> str | None:
    """Return the known name at the end of a name with any namespace or joint."""
    return next((x for x in known if ('/' + name.lstrip('/')).endswith(x)), None)


def _check_installed(words: list[str]) -> None:
    program = words[0]
    if program == 'hmsa':
        _check_hmsa(words[1:])
        return
    if program != 'ros2':
        _require(program in FOREIGN, f'{program!r} is no program known to be part of ROS 2')
        return
    plain = [x for x in words if not x.startswith('-')]
    kind = plain[1:3]
    if words[1:2] == ['run'] and words[2:3] == ['hmsa_ros']:
        _check_run(words[3], words[4:])
    elif words[1:2] == ['launch'] and words[2:3] == ['hmsa_ros']:
        _check_launch(words[3], words[4:])
    elif kind in (['topic', 'pub'], ['service', 'call']):
        _check_message(kind[0], [x for x in plain[3:] if not re.fullmatch(r'\d+(\.\d+)?', x)])
    elif kind[:1] == ['topic'] and len(plain) > 3:
        _require(_known_name(plain[3], topics_by_name()), f'no topic {plain[3]!r}')
    elif kind[:1] == ['param'] and len(plain) > 4 and kind[1] in ('get', 'set', 'describe'):
        node = plain[3].rpartition('/')[2]
        _require(node in _nodes(), f'no node {plain[3]!r}')
        _check_parameter(plain[4], [node])
    elif kind[:1] in (['param'], ['lifecycle'], ['node']) and len(plain) > 3:
        _require(plain[3].rpartition('/')[2] in _nodes(), f'no node {plain[3]!r}')


def _check_run(name: str, rest: list[str]) -> None:
    scripts = {*_nodes(), 'hmsa'}
    _require(name in scripts, f'hmsa_ros has no executable {name!r}')
    if name == 'hmsa':
        _check_hmsa(rest)
    else:
        _check_parameters(name, rest)


def _check_parameters(node: str, words: list[str]) -> None:
    for option, value in zip(words, words[1:], strict=False):
        if option == '-p':
            _check_parameter(value.partition(':=')[0], [node])


def _check_hmsa(words: list[str]) -> None:
    """Require that a command line can be parsed, without running it."""
    from hmsa.cli import build_parser, split_ros_args

    try:
        build_parser().parse_args(split_ros_args(words))
    except SystemExit as end:
        _require(end.code == 0, f'hmsa does not understand {shlex.join(words)!r}')
    if words[0] in _nodes():
        _check_parameters(words[0], words)


def check_named(text: str) -> None:
    """Require that the commands and options that the text of a page names exist."""
    from hmsa.cli import build_parser
    from hmsa.cli.completion import commands_of

    known = {x.path: {name for y in x.options for name in y.names}
             for x in commands_of(build_parser())}
    # Blocks are checked on their own.
    for code in re.findall(r'`([^`]+)`', re.sub(
            r'^ *(`{3,}).*?^ *\1 *$', '', text, flags=re.M | re.S)):
        program, *words = code.split() or ['']
        if program != 'hmsa' or not words:
            continue
        path = next((x for x in (' '.join(words[:2]), words[0]) if x in known), '')
        inner = [x for x in known if x.startswith(f'{path} ')]
        _require(path and not (inner and words[1:]), f'hmsa has no command of {code!r}')
        # What follows is for ROS.
        options = words[:words.index('--ros-args')] if '--ros-args' in words else words
        for option in (x.partition('=')[0] for x in options if re.match('--[a-z]', x)):
            _require(option in known[path], f'hmsa {path} has no option {option!r} ({code})')


def _check_launch(name: str, rest: list[str]) -> None:
    file = ROOT / 'launch' / name
    _require(file.is_file(), f'no launch file {name!r}')
    from hmsa_ros.clients import launching

    known = {x.name: x for x in getattr(launching, name.partition('.')[0].upper()).arguments}
    for word in rest:
        if ':=' in word:
            argument, _, value = word.partition(':=')
            _require(argument in known, f'{name} has no argument {argument!r}')
            _require(not known[argument].choices or value in known[argument].choices,
                     f'{name}: {argument} cannot be {value!r}')


def _check_message(kind: str, words: list[str]) -> None:
    """Require that a payload matches the type, and the type the topic or service."""
    name, type_name = words[:2]
    package, group, cls = type_name.split('/')
    message = getattr(import_module(f'{package}.{group}'), cls)
    if kind == 'topic':
        known = topics_by_name()
    else:
        known, message = services_by_name(), message.Request
    found = _known_name(name, known)
    _require(found, f'no {kind} {name!r}')
    is_type = known[str(found)].type
    _require(is_type == type_name,
             f'{name} has type {is_type.rpartition("/")[2]}, not {type_name}')
    if len(words) > 2:
        _fill(message(), yaml.safe_load(words[2]))


def _fill(message: Any, values: Any) -> None:
    """Set the fields of a message; rclpy refuses values of the wrong type."""
    _require(isinstance(values, dict), f'{values!r} does not fit {type(message).__name__}')
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        _require(name in types, f'{type(message).__name__} has no field {name!r}')
        listed = re.fullmatch(r'sequence<(\w+)/(\w+)>', types[name])
        if listed:
            element = getattr(import_module(f'{listed[1]}.msg'), listed[2])
            filled = []
            for part in value:
                filled.append(element())
                _fill(filled[-1], part)
            setattr(message, name, filled)
        elif '/' in types[name]:
            _fill(getattr(message, name), value)
        else:
            field = getattr(message, name)
            try:
                setattr(message, name, type(field)(value) if isinstance(field, float) else value)
            except AssertionError as error:
                raise Failure(f'{name}: {value!r} is no {types[name]}') from error


def _check_repository(words: list[str]) -> None:
    # The environment may have another name.
    program = words[0].removeprefix('.venv/bin/')
    if program == 'make':
        targets = re.findall(r'^([a-z]+):', (ROOT / 'Makefile').read_text(), re.M)
        for word in words[1:]:
            _require('=' in word or word in targets, f'make has no target {word!r}')
    elif program in ('pip', 'python') and 'install' in words:
        from distutils.core import run_setup

        extras = run_setup(str(ROOT / 'setup.py'), stop_after='init').extras_require
        for word in re.findall(r'\[([\w,]+)\]', ' '.join(words)):
            for extra in word.split(','):
                _require(extra in extras, f'setup.py has no extra {extra!r}')
    elif '/' in program:
        _require((ROOT / program).is_file(), f'no file {program}')
    elif program in ('python', 'python3') and words[1] == '-m':
        place = ROOT / words[2].replace('.', '/')
        _require(place.with_suffix('.py').is_file() or (place / '__main__.py').is_file(),
                 f'no module {words[2]}')
    elif program in ('python', 'python3'):
        _require((ROOT / words[1]).is_file(), f'no file {words[1]}')
    else:
        _require(program in ('.', 'source', 'cd', 'git', 'export'),
                 f'{program!r} does not set a clone up')
