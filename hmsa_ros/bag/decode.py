"""Decoding the messages of a topic by the definition that its bag holds."""

from collections.abc import Callable
import contextlib
import io
import re
from typing import Any

from hmsa_ros.bag import limits
from hmsa_ros.bag.topics import Topic
from hmsa_ros.errors import BagError

# A field that is an array of messages.
_NESTED = re.compile(r'^\s*(?:[A-Z]\w*|\w+/[\w/]+)\s*\[', re.MULTILINE)


def make_decoder(info: Topic) -> Callable[[bytes], Any]:
    """Return what decodes a topic's payloads; both raise `BagError` where it cannot be done."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory
    # A decoder of its own: the library keeps decoders by schema number, which differs between
    # the files of a bag.
    try:
        # Its parser prints before it raises.
        with contextlib.redirect_stderr(io.StringIO()), \
                contextlib.redirect_stdout(io.StringIO()):
            decode = DecoderFactory().decoder_for(info.encoding, Schema(
                id=1, name=info.type, encoding=info.definition_encoding,
                data=info.definition.encode()))
    except Exception as error:  # the parser raises errors of many unrelated classes
        raise BagError(f'the definition of {info.type} in the bag cannot be read: '
                       f'{error}') from error
    if decode is None:
        raise BagError(
            f'messages of topic {info.name} ({info.type or "unknown type"}) cannot be decoded: '
            f'expected CDR with a ros2msg definition, got {info.encoding!r} with '
            f'{info.definition_encoding or "no definition"!r}')

    # Arrays of primitive values take what they say of their length; those of messages may take
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
