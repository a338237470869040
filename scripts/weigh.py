"""
Print how large the packages are, and how far a setpoint travels through them.

Used by ``make weight``. Lines of code have no blank lines, comments and docstrings.
"""

import ast
from collections import defaultdict
from collections.abc import Iterator
import io
from pathlib import Path
import sys
import tokenize
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

PACKAGES = ('hmsa', 'hmsa_ros', 'hmsa_lab', 'hmsa_studies')
ROOMS = ('hmsa/planning', 'hmsa_ros/runtime')
MS = 10**6
_NO_CODE = (
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER)


def files(*places: str) -> list[Path]:
    """Return the Python files below some places."""
    return sorted(x for place in places for x in (ROOT / place).rglob('*.py'))


def code_lines(path: Path) -> int:
    """Return the number of lines of code of a Python file."""
    text = path.read_text(encoding='utf-8')
    lines = {
        line for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in _NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(
                    first.value, ast.Constant) and isinstance(first.value.value, str):
                lines -= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return len(lines)


def compiled_lines() -> int:
    """Return the number of lines of C and C++ without blank lines and comments."""
    sources = [x for y in PACKAGES for x in (ROOT / y).rglob('*')
               if x.suffix in ('.c', '.cpp', '.hpp')]
    return sum(
        bool(line.strip()) and not line.strip().startswith(('//', '/*', '*'))
        for x in sources for line in x.read_text(encoding='utf-8').splitlines())


def trace() -> dict[str, int]:
    """Return modules, functions and depth of calls of a setpoint until its plan is adopted."""
    from hmsa.model.actuators import Setup
    from hmsa.model.parameters import paper_actuator
    from hmsa.planning.group import PlannerGroup
    from hmsa.planning.planner import Options, Planner
    from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
    from hmsa_ros.runtime.loop import Loop
    from hmsa_ros.runtime.records import Settings, StretchRequest

    block = paper_actuator()
    options = Options(flux_density_min=-0.5, flux_density_max=0.5)
    device = SimulatedDevice([SimulatedJoint(Setup(block))], period=MS, time=1000 * MS)
    loop = Loop(
        PlannerGroup({'a': Planner(block, options)}), Settings(takeover_timeout=0), device)
    loop.run(1010 * MS)
    request, seen = StretchRequest('a', 1.1), defaultdict(set)
    depth = deepest = 0
    folders = tuple(str(ROOT / x) + '/' for x in PACKAGES)

    def note(frame: FrameType, event: str, _: Any) -> None:
        nonlocal depth, deepest
        if frame.f_code.co_filename.startswith(folders):
            if event == 'call':
                depth += 1
                deepest = max(deepest, depth)
                seen[frame.f_code.co_filename].add(frame.f_code.co_name)
            elif event == 'return':
                depth -= 1

    sys.setprofile(note)
    loop.runtime.request(request)
    sys.setprofile(None)
    return {'modules': len(seen), 'functions': sum(map(len, seen.values())), 'deepest': deepest}


def shared_names() -> list[str]:
    """Return the names that several classes have, without leading underscores."""
    places = defaultdict(list)
    for x in files(*PACKAGES):
        for node in ast.walk(ast.parse(x.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ClassDef):
                places[node.name.lstrip('_')].append(x)
    return sorted(name for name, found in places.items() if len(found) > 1)


def rows() -> Iterator[tuple[str, object]]:
    """Yield what is measured, and its value."""
    path = trace()
    yield 'a setpoint until its plan is adopted, feedback off: modules', path['modules']
    yield '  functions', path['functions']
    yield '  depth of calls', path['deepest']
    yield '"yield from" in planning and runtime', sum(
        x.read_text(encoding='utf-8').count('yield from') for x in files(*ROOMS))
    lines = {x: sum(map(code_lines, files(x))) for x in PACKAGES}
    for name, count in lines.items():
        yield f'lines of code, {name}', count
    yield '  all packages', sum(lines.values())
    yield '  C and C++', compiled_lines()
    yield '  tests', sum(map(code_lines, files('test')))
    yield '  studies and benchmarks', lines['hmsa_studies'] + sum(
        map(code_lines, files('benchmarks')))
    yield 'modules of all packages', len(files(*PACKAGES))
    shared = shared_names()
    yield 'names that several classes have', f'{len(shared)} ({", ".join(shared)})'


def main() -> None:
    """Print the table."""
    for name, value in rows():
        print(f'{name:<64} {value}')


if __name__ == '__main__':
    main()
