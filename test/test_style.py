"""Rules of this project that ruff does not know."""

import ast
from collections.abc import Iterator
from pathlib import Path
import re
import sys

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = sorted((ROOT / 'hmsa_ros').rglob('*.py'))
TESTS = sorted((ROOT / 'test').glob('test_*.py'))
SHORTEST_SENTENCE = 3
# A section of its own, or a sentence that names the class.
RAISES = re.compile(r'\nRaises\n------\n|`\w+Error`')

Function = ast.FunctionDef | ast.AsyncFunctionDef


def name_of(path: Path) -> str:
    """Return a path as it reads from the root of the repository."""
    return str(path.relative_to(ROOT))


def functions(path: Path) -> list[Function]:
    """Return all functions in a file."""
    return [node for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
            if isinstance(node, Function)]


def public_functions(path: Path) -> Iterator[Function]:
    """Walk the functions and methods that a user of a module can call."""
    pending: list[ast.stmt] = ast.parse(path.read_text(encoding='utf-8')).body
    while pending:
        node = pending.pop()
        if isinstance(node, ast.ClassDef):
            pending = [*pending, *node.body]
        elif isinstance(node, Function) and not node.name.startswith('_'):
            yield node


def own_nodes(function: Function) -> Iterator[ast.AST]:
    """Walk a function's body without what it defines and what it may catch itself."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        yield node
        if isinstance(node, ast.Try) and node.handlers:
            pending += [*node.handlers, *node.orelse, *node.finalbody]
        elif not isinstance(node, Function | ast.ClassDef | ast.Lambda):
            pending += ast.iter_child_nodes(node)


@pytest.mark.parametrize('path', TESTS, ids=name_of)
def test_names_of_tests_are_sentences(path):
    tests = [function.name for function in functions(path)
             if function.name.startswith('test_')]
    assert tests
    assert [name for name in tests
            if len(name.removeprefix('test_').split('_')) < SHORTEST_SENTENCE] == []


@pytest.mark.parametrize('path', TESTS, ids=name_of)
def test_modules_of_tests_say_what_they_test(path):
    assert ast.get_docstring(ast.parse(path.read_text(encoding='utf-8')))


@pytest.mark.parametrize('path', PACKAGE, ids=name_of)
def test_package_raises_errors_and_does_not_assert(path):
    tree = ast.parse(path.read_text(encoding='utf-8'))
    assert [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Assert)] == []


@pytest.mark.parametrize('path', PACKAGE, ids=name_of)
def test_module_does_not_shadow_the_standard_library(path):
    assert path.stem in {'__init__', '__main__'} or path.stem not in sys.stdlib_module_names


@pytest.mark.parametrize('path', PACKAGE, ids=name_of)
def test_public_function_that_raises_says_so(path):
    silent = [
        function.name for function in public_functions(path)
        if any(isinstance(node, ast.Raise) and node.exc is not None
               for node in own_nodes(function))
        and not RAISES.search(ast.get_docstring(function) or '')]
    assert silent == []


@pytest.mark.parametrize('path', TESTS, ids=name_of)
def test_tests_wait_on_conditions_and_do_not_sleep(path):
    sleeps = [
        node.lineno for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {'time.sleep', 'sleep'}]
    assert sleeps == []
