"""
What a bag may cost whoever reads it.

A bag may come from anybody. Its lengths and counts are held against these limits before memory
is taken for them, and its YAML is counted before it is built.
"""

import json
import math
import reprlib
from typing import Any

from hmsa_ros.errors import BagError

MEBIBYTE = 2**20
#: Largest content of a chunk, and largest message; what a reader may be told otherwise.
CHUNK_SIZE = 128 * MEBIBYTE
#: Content of chunks that overlap in time, as a multiple of the largest chunk.
CHUNKS_AT_ONCE = 4
#: Chunks of a file; with rosbag2's usual chunks that is more than a terabyte.
CHUNKS = 2_000_000
#: Channels of a file, and schemas; each topic costs a player a publisher.
CHANNELS = 8192
#: Topics of a bag.
TOPICS = 4096
#: Summary of a file, that of half a terabyte in usual chunks.
SUMMARY_SIZE = 128 * MEBIBYTE
#: Data held against their CRC as a whole when a bag is summarized: seconds.
CHECKED_SIZE = 1024 * MEBIBYTE
#: Record of a schema, a channel, statistics or metadata.
RECORD_SIZE = 16 * MEBIBYTE
#: All schemas, channels and metadata that are kept of a bag.
KEPT_SIZE = 64 * MEBIBYTE
#: Definition of a message type with all it depends on.
DEFINITION_SIZE = 2 * MEBIBYTE
#: Entries of a map in a record.
MAP_ENTRIES = 100_000
#: Message to be decoded whose type has arrays of messages: each may take a hundred times its
#: bytes in Python.
DECODED_SIZE = 8 * MEBIBYTE
#: File ``metadata.yaml``.
YAML_SIZE = 16 * MEBIBYTE
#: Values, lists and maps in a YAML text.
YAML_NODES = 300_000
#: Lists and maps inside each other.
YAML_DEPTH = 30
#: Sentences about what cannot be read.
PROBLEMS = 200


def load_json(text: str) -> Any:
    """Return what a JSON text holds; raise `BagError` unless all its numbers are finite."""
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
    """Return what a YAML text holds; raise `BagError` if it is none, too large, or has anchors."""
    import yaml  # whoever plans without files need not wait for it

    # The C parser is some ten times faster; not every installation of PyYAML has it.
    loader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    if len(text) > YAML_SIZE:
        raise BagError(f'it has {len(text)} characters, expected at most {YAML_SIZE}')
    nodes = depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            if isinstance(event, yaml.AliasEvent):
                # With these a few lines unfold to more than fits into any memory.
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
        return yaml.load(text, loader)
    except BagError:
        raise
    except Exception as error:  # values that do not fit their tags raise errors of any class
        raise BagError(f'it is not YAML: {" ".join(str(error).split())[:200]}') from error
