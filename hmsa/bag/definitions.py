"""
Message definitions of installed interface packages, with their hashes, and of bags.

A bag contains the definition of each message type with its dependencies, so that readers do not
need ROS. Definitions are read from the ``share`` folders of the environment, without rclpy.
"""

from collections.abc import Callable
import contextlib
from dataclasses import replace
from functools import cache, partial
import io
import json
import os
from pathlib import Path
import re
import sys
from typing import Any, TYPE_CHECKING

from hmsa.bag import limits
from hmsa.errors import BagError

if TYPE_CHECKING:  # slow to import
    from hmsa.bag.metadata import BagTopic

# Built-in types of .msg files.
_BUILTIN = frozenset((
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
    'uint32', 'int64', 'uint64', 'string', 'wstring'))
_FIELD = re.compile(r'^([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*')
#: Encoding of the messages of ROS 1, and of their definitions.
ROS1 = 'ros1'
#: The one usual type whose definition is empty.
EMPTY = 'std_msgs/msg/Empty'
# Before each definition of a bag in IDL.
_IDL = re.compile(r'^={80}\nIDL: .*\n', re.MULTILINE)
_SEPARATOR = '\n' + '=' * 80 + '\nMSG: '


def share_folders() -> list[Path]:
    """Return the share folders of AMENT_PREFIX_PATH in order, then of this Python environment."""
    prefixes = [prefix for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
                if prefix]
    return [Path(prefix) / 'share' for prefix in [*prefixes, sys.prefix]]


def is_interface_package(name: str) -> bool:
    """Return whether a package is installed as a ROS package, not just as a Python module."""
    return re.fullmatch(r'[A-Za-z]\w*', name) is not None and any(
        (folder / name / 'package.xml').is_file() for folder in share_folders())


def _split(type_name: str) -> tuple[str, str]:
    """Split 'pkg/msg/Name' or 'pkg/Name'."""
    parts = type_name.split('/')
    if len(parts) not in (2, 3) or not all(re.fullmatch(r'\w+', part) for part in parts):
        raise BagError(
            f'message type is {type_name!r}: expected a name such as std_msgs/msg/Float64')
    return parts[0], parts[-1]


def _find(type_name: str, suffix: str) -> Path | None:
    """Return the file of a type; None if it is not installed."""
    package, name = _split(type_name)
    for folder in share_folders():
        path = folder / package / 'msg' / f'{name}{suffix}'
        if path.is_file():
            return path
    return None


def _dependencies(type_name: str, text: str) -> list[str]:
    """Return the types that a definition uses, as pkg/Name, sorted."""
    package, _ = _split(type_name)
    names = set()
    for line in text.splitlines():
        match = _FIELD.match(line.split('#', 1)[0].strip())
        if match and match[1] not in _BUILTIN:
            name = 'std_msgs/Header' if match[1] == 'Header' else match[1]
            names.add('/'.join(_split(name if '/' in name else f'{package}/{name}')))
    return sorted(names)


@cache
def message_definition(type_name: str) -> tuple[str, str]:
    """Return ``'ros2msg'`` and the definition of a type with dependencies; raise `BagError`."""
    sections: list[str] = []
    names = ['/'.join(_split(type_name))]
    for name in names:
        path = _find(name, '.msg')
        if path is None:
            raise BagError(
                f'no definition of message type {name if sections else type_name} found under '
                + ', '.join(map(str, share_folders()))
                + ': expected an installed interface package; source its workspace')
        text = path.read_text(encoding='utf-8')
        sections.append(f'{_SEPARATOR}{name}\n{text}' if sections else text)
        names += [x for x in _dependencies(name, text) if x not in names]
    return 'ros2msg', ''.join(sections)


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type; empty if it is not installed."""
    path = _find(type_name, '.json')
    if path is None:
        return ''
    try:
        hashes = json.loads(path.read_text(encoding='utf-8'))['type_hashes']
        return next((str(entry['hash_string']) for entry in hashes
                     if '/'.join(_split(entry['type_name'])) == '/'.join(_split(type_name))), '')
    except (ValueError, KeyError, TypeError):
        return ''


# A field that is an array of messages.
_NESTED = re.compile(r'^\s*(?:[A-Z]\w*|\w+/[\w/]+)\s*\[', re.MULTILINE)


def installed(topic: 'BagTopic') -> 'BagTopic':
    """
    Return a topic without a definition with that of its installed type.

    Raise `BagError` if the type is not installed, or is another one than that recorded.
    """
    encoding, definition = message_definition(topic.type)
    found = type_hash(topic.type)
    if topic.type_hash and found and topic.type_hash != found:
        raise BagError(
            f'the installed {topic.type} is not the recorded one, as their hashes differ')
    return replace(topic, definition=definition, definition_encoding=encoding)


def _decoder_of_rosbags(info: 'BagTopic') -> Callable[[bytes], Any]:
    """Return the decoder of a topic of ROS 1, or defined in IDL."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
    store = get_typestore(Stores.EMPTY)
    if info.encoding == ROS1:
        store.register(get_types_from_msg(info.definition, info.type))
        return partial(store.deserialize_ros1, typename=info.type)
    for text in filter(str.strip, _IDL.split(info.definition)):
        store.register(get_types_from_idl(text))
    return partial(store.deserialize_cdr, typename=info.type)


def make_decoder(info: 'BagTopic') -> Callable[[bytes], Any]:
    """Return the decoder of a topic's payloads; both raise `BagError` if they cannot decode."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory
    if not info.definition.strip() and info.type != EMPTY and info.encoding == 'cdr':
        raise BagError(f'topic {info.name} ({info.type or "unknown type"}) cannot be decoded: it '
                       'has no message definition in the bag, and its type is not installed')
    # A new factory for each topic: the library caches decoders by schema id, which differs between
    # the files of a bag.
    try:
        # Its parser prints before it raises.
        with contextlib.redirect_stderr(io.StringIO()), \
                contextlib.redirect_stdout(io.StringIO()):
            foreign = info.encoding == ROS1 or (
                info.encoding, info.definition_encoding) == ('cdr', 'ros2idl')
            decode = _decoder_of_rosbags(info) if foreign else (
                DecoderFactory().decoder_for(info.encoding, Schema(
                    id=1, name=info.type, encoding=info.definition_encoding,
                    data=info.definition.encode())))
    except Exception as error:  # the parser raises errors of many unrelated classes
        raise BagError(f'the definition of {info.type} in the bag cannot be read: '
                       f'{error}') from error
    if decode is None:
        raise BagError(
            f'messages of topic {info.name} ({info.type or "unknown type"}) cannot be decoded: '
            f'expected CDR with a ros2msg or ros2idl definition, got {info.encoding!r} with '
            f'{info.definition_encoding or "no definition"!r}')

    # Decoded arrays of primitive values take about their encoded size; arrays of messages may take
    # a hundred times as much.
    most = limits.DECODED_SIZE if _NESTED.search(info.definition) else limits.CHUNK_SIZE

    def checked(data: bytes) -> Any:
        if len(data) > most:
            raise BagError(
                f'a message of topic {info.name} has {len(data)} bytes: expected at most {most} '
                f'of a message of type {info.type} to be decoded')
        try:
            return decode(data)
        except Exception as error:
            raise BagError(f'a message of topic {info.name} does not decode as {info.type}: '
                           f'{str(error) or type(error).__name__}') from error

    return checked
