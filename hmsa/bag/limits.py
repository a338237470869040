"""
Limits on the resources that reading a bag may take.

Bags can come from untrusted sources. Their sizes and counts are checked against these limits
before memory is allocated, and YAML is checked before it is loaded.
"""

from collections import Counter
import json
import math
import reprlib
from typing import Any

from hmsa.errors import BagError, excerpt

MEBIBYTE = 2**20
#: Largest content of a chunk, and largest message; readers can be given another limit.
CHUNK_SIZE = 128 * MEBIBYTE
#: Content of chunks that overlap in time, as a multiple of the largest chunk.
CHUNKS_AT_ONCE = 4
#: Summary of a file, that of half a terabyte in usual chunks.
SUMMARY_SIZE = 128 * MEBIBYTE
#: Largest data section whose CRC is checked when a bag is summarized, which takes seconds.
CHECKED_SIZE = 1024 * MEBIBYTE
#: Record of a schema, a channel, statistics or metadata.
RECORD_SIZE = 4 * MEBIBYTE
#: All schemas, channels and metadata that are kept of a file.
KEPT_SIZE = 64 * MEBIBYTE
#: Largest message of a type with arrays of messages that is decoded: in Python it may take a
#: hundred times its size.
DECODED_SIZE = 8 * MEBIBYTE
#: File ``metadata.yaml``.
YAML_SIZE = 16 * MEBIBYTE
#: Values, lists and maps in a YAML text.
YAML_NODES = 300_000
#: Lists and maps inside each other; a hundred thousand crash the C parser.
YAML_DEPTH = 30
#: Sentences about unreadable parts.
PROBLEMS = 200


def load_json(text: str) -> Any:
    """Return the content of a JSON text; raise `BagError` unless all its numbers are finite."""
    def number(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise ValueError(digits)
        return value

    try:
        return json.loads(text, parse_float=number, parse_constant=number)
    except (ValueError, RecursionError) as error:
        raise BagError(
            f'{reprlib.repr(text)} cannot be read: expected JSON with finite numbers') from error


def load_yaml(text: str) -> Any:
    """
    Return the content of a YAML text.

    Raise `BagError` if it is invalid, too large or aliased, or gives a key twice, of which a
    parser would take the last and ROS 2 both.
    """
    import yaml  # slow to import

    # The C parser is some ten times faster; not every installation of PyYAML has it.
    loader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    if len(text) > YAML_SIZE:
        raise BagError(f'it has {len(text)} characters, expected at most {YAML_SIZE}')
    nodes = depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            if isinstance(event, yaml.AliasEvent):
                # With aliases, a few lines can expand to more than any memory.
                raise BagError('it uses YAML anchors, expected plain YAML')
            if isinstance(event, yaml.NodeEvent):
                nodes += 1
                if nodes > YAML_NODES:
                    raise BagError(f'it has more than {YAML_NODES} values')
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
                if depth > YAML_DEPTH:
                    raise BagError(f'it is nested deeper than {YAML_DEPTH}')
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1

        class Unique(loader):  # type: ignore[misc]
            def construct_mapping(self, node: Any, deep: bool = False) -> Any:
                keys = Counter(x.value for x, _ in node.value if isinstance(x, yaml.ScalarNode))
                if twice := [x for x, count in keys.items() if count > 1]:
                    raise BagError(
                        f'line {node.start_mark.line + 1} begins a mapping with several '
                        f'{excerpt(twice[0])}, expected each key once')
                return super().construct_mapping(node, deep)

        return yaml.load(text, Unique)
    except BagError:
        raise
    except Exception as error:  # values that do not fit their tags raise errors of any class
        raise BagError(f'it is not YAML: {" ".join(str(error).split())[:200]}') from error
