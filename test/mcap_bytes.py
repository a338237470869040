"""MCAP records as bytes, built with the mcap package, for modified and malicious files."""

import struct

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, Schema

from hmsa.bag.records import MAGIC, PREFIX


def made(record):
    """Return a record of the mcap package as bytes."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def record(opcode, content):
    """Return any record."""
    return PREFIX.pack(opcode, len(content)) + content


def pieces(data):
    """Return opcode, offset and content of each record of a file."""
    offset = len(MAGIC)
    while offset < len(data) - len(MAGIC):
        opcode, length = PREFIX.unpack_from(data, offset)
        start = offset + PREFIX.size
        yield opcode, offset, data[start:start + length]
        offset = start + length


def chunk(packed, size, compression='zstd', start=1, end=1):
    """Return a chunk with arbitrary header values."""
    name = compression.encode()
    return record(Opcode.CHUNK, struct.pack('<QQQII', start, end, size, 0, len(name)) + name
                  + struct.pack('<Q', len(packed)) + packed)


def schema(number, name, data):
    """Return the declaration of a message type."""
    return made(Schema(id=number, name=name, encoding='ros2msg', data=data))


def channel(number, schema_id, topic, values=None):
    """Return the declaration of a topic."""
    return made(Channel(id=number, schema_id=schema_id, topic=topic, message_encoding='cdr',
                        metadata=values or {}))


def metadata(name, values):
    """Return a metadata record."""
    return made(Metadata(name=name, metadata=values))


BEGIN = MAGIC + made(Header('ros2', 'a stranger'))
END = made(DataEnd(0)) + made(Footer(0, 0, 0)) + MAGIC
