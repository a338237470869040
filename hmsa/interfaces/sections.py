"""Sections of a parameter file, and the nodes that read them: the rules of ROS 2."""

from collections.abc import Iterator, Mapping
import re
from typing import Any

_KEY = 'ros__parameters'


def sections_of(document: Any, name: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the full name and the parameters of each section, such as ``/**`` or ``/planner``."""
    if not isinstance(document, Mapping):
        return
    for key, values in document.items():
        if key == _KEY:
            yield name or '/', values if isinstance(values, Mapping) else {}
        else:
            yield from sections_of(values, f'{name}/{str(key).strip("/")}')


def is_for(section: str, node: str) -> bool:
    """Return whether a node with this full name reads a section; ``*`` is any one name."""
    tokens = section.strip('/').split('/')
    return re.fullmatch(''.join(
        '(?:/[^/]+)*' if x == '**' else '/[^/]+' if x == '*' else f'/{re.escape(x)}'
        for x in tokens), node) is not None
