"""Rules of this project that ruff does not cover."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
import re
import sys

import pytest

pytestmark = pytest.mark.lint
ROOT = Path(__file__).resolve().parent.parent
PACKAGE = sorted(x for y in ('hmsa_ros', 'hmsa_studies') for x in (ROOT / y).rglob('*.py'))
TESTS = sorted((ROOT / 'test').glob('test_*.py'))
SHORTEST_SENTENCE = 3
# A section of its own, or a sentence that names the class.
RAISES = re.compile(r'\nRaises\n------\n|`\w+Error`')

Function = ast.FunctionDef | ast.AsyncFunctionDef


def name_of(path: Path) -> str:
    """Return a path relative to the root of the repository."""
    return str(path.relative_to(ROOT))


@cache
def tree(path: Path) -> ast.Module:
    """Return a file's syntax tree."""
    return ast.parse(path.read_text(encoding='utf-8'))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of a file's syntax tree."""
    return tuple(ast.walk(tree(path)))


def public_functions(path: Path) -> Iterator[Function]:
    """Yield the functions and methods that are public in a module."""
    pending: list[ast.stmt] = tree(path).body
    while pending:
        node, *pending = pending
        if isinstance(node, ast.ClassDef):
            pending = [*pending, *node.body]
        elif isinstance(node, Function) and not node.name.startswith('_'):
            yield node


def own_nodes(function: Function) -> Iterator[ast.AST]:
    """Yield a function's nodes, without nested definitions and bodies with handlers."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        yield node
        if isinstance(node, ast.Try) and node.handlers:
            pending += [*node.handlers, *node.orelse, *node.finalbody]
        elif not isinstance(node, Function | ast.ClassDef | ast.Lambda):
            pending += ast.iter_child_nodes(node)


def test_names_of_tests_are_sentences():
    names = {path: [x.name for x in nodes(path)
                    if isinstance(x, Function) and x.name.startswith('test_')] for path in TESTS}
    assert [name_of(path) for path in TESTS if not names[path]] == []
    assert [(name_of(path), name) for path in TESTS for name in names[path]
            if len(name.removeprefix('test_').split('_')) < SHORTEST_SENTENCE] == []


def test_modules_of_tests_say_what_they_test():
    assert [name_of(path) for path in TESTS if not ast.get_docstring(tree(path))] == []


def test_package_raises_errors_and_does_not_assert():
    assert [(name_of(path), node.lineno) for path in PACKAGE for node in nodes(path)
            if isinstance(node, ast.Assert)] == []


def test_module_does_not_shadow_the_standard_library():
    assert [name_of(path) for path in PACKAGE if path.stem not in {'__init__', '__main__'}
            and path.stem in sys.stdlib_module_names] == []


def test_public_function_that_raises_says_so():
    silent = [
        (name_of(path), function.name) for path in PACKAGE for function in public_functions(path)
        if any(isinstance(node, ast.Raise) and node.exc is not None
               for node in own_nodes(function))
        and not RAISES.search(ast.get_docstring(function) or '')]
    assert silent == []


def test_tests_wait_on_conditions_and_do_not_sleep():
    sleeps = [
        (name_of(path), node.lineno) for path in TESTS for node in nodes(path)
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {'time.sleep', 'sleep'}]
    assert sleeps == []
