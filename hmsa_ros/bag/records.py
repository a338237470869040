"""
MCAP records as bytes: the subset that rosbag2 writes.

https://mcap.dev/spec. Little endian; a record is its opcode (1 byte), the length of its content
(8 bytes) and the content. Decoding takes any bytes and raises `BagError` for what is no record,
never another exception.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import struct
import zlib

from hmsa_ros.bag import limits
from hmsa_ros.errors import BagError

MAGIC = b'\x89MCAP0\r\n'
HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
MESSAGE_INDEX = 0x07
CHUNK_INDEX = 0x08
ATTACHMENT = 0x09
STATISTICS = 0x0B
METADATA = 0x0C
METADATA_INDEX = 0x0D
SUMMARY_OFFSET = 0x0E
DATA_END = 0x0F
OPCODES = frozenset(range(0x01, 0x10))

PREFIX = struct.Struct('<BQ')
# Opcode, length, channel, sequence, log time, publish time; the payload follows.
MESSAGE_HEAD = struct.Struct('<BQHIQQ')
MESSAGE_FIXED = MESSAGE_HEAD.size - PREFIX.size
FOOTER_SIZE = PREFIX.size + 20
_CHUNK_HEAD = struct.Struct('<QQQI')


@dataclass(frozen=True)
class Schema:
    """A message type: name, encoding of its definition, and the definition."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A topic: name, encoding of its messages, schema and metadata."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: Mapping[str, str]


@dataclass(frozen=True)
class ChunkHead:
    """
    What a chunk says of itself before its data.

    Attributes
    ----------
    start, end : int
        Lowest and highest log time in it.
    size, crc : int
        Length and CRC-32 of the content before compression; a CRC of 0 was not computed.
    compression : str
        ``''``, ``'lz4'`` or ``'zstd'``.
    data_offset, data_length : int
        Where the compressed content lies within the record's content.

    """

    start: int
    end: int
    size: int
    crc: int
    compression: str
    data_offset: int
    data_length: int


def record(opcode: int, content: bytes) -> bytes:
    """
    Return a record.

    Parameters
    ----------
    opcode : int
        Kind of record.
    content : bytes
        Its content.

    Returns
    -------
    bytes
        The record.

    """
    return PREFIX.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    """
    Return a string with its length before it.

    Parameters
    ----------
    value : str
        Any text.

    Returns
    -------
    bytes
        Encoded.

    """
    data = value.encode('utf-8', 'backslashreplace')
    return struct.pack('<I', len(data)) + data


def text_map(values: Mapping[str, str]) -> bytes:
    """
    Return a map of strings with its length before it.

    Parameters
    ----------
    values : mapping of str to str
        Any texts.

    Returns
    -------
    bytes
        Encoded.

    """
    data = b''.join(text(key) + text(value) for key, value in values.items())
    return struct.pack('<I', len(data)) + data


def header(profile: str, library: str) -> bytes:
    """Return the record that opens a file."""
    return record(HEADER, text(profile) + text(library))


def schema(value: Schema) -> bytes:
    """Return a schema record."""
    return record(SCHEMA, struct.pack('<H', value.id) + text(value.name) + text(value.encoding)
                  + struct.pack('<I', len(value.data)) + value.data)


def channel(value: Channel) -> bytes:
    """Return a channel record."""
    return record(CHANNEL, struct.pack('<HH', value.id, value.schema_id) + text(value.topic)
                  + text(value.encoding) + text_map(value.metadata))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Return a metadata record."""
    return record(METADATA, text(name) + text_map(values))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Return the summary's entry of a metadata record."""
    return record(METADATA_INDEX, struct.pack('<QQ', offset, length) + text(name))


def summary_offset(opcode: int, start: int, length: int) -> bytes:
    """Return the entry that tells where the summary's records of one kind lie."""
    return record(SUMMARY_OFFSET, struct.pack('<BQQ', opcode, start, length))


def data_end() -> bytes:
    """Return the record that ends the data section, without a CRC over all of it."""
    return record(DATA_END, struct.pack('<I', 0))


def footer(summary_start: int, offsets_start: int, summary: bytes) -> bytes:
    """Return the record that closes a file, with the CRC of the summary before it."""
    head = PREFIX.pack(FOOTER, 20) + struct.pack('<QQ', summary_start, offsets_start)
    return head + struct.pack('<I', zlib.crc32(head, zlib.crc32(summary)))


class Fields:
    """
    Reads the fields of a record one after the other.

    Parameters
    ----------
    data : bytes
        Content of one record.
    what : str
        Kind of record, for messages.

    """

    def __init__(self, data: bytes | memoryview, what: str) -> None:
        self._data = memoryview(data)
        self._what = what
        self.offset = 0

    def take(self, length: int) -> bytes:
        """
        Return the next bytes.

        Parameters
        ----------
        length : int
            How many.

        Returns
        -------
        bytes
            A copy of them.

        Raises
        ------
        BagError
            If the record ends before.

        """
        end = self.offset + length
        if length < 0 or end > len(self._data):
            raise BagError(f'a {self._what} record ends early')
        value = bytes(self._data[self.offset:end])
        self.offset = end
        return value

    def number(self, size: int) -> int:
        """Return the next unsigned number of some bytes."""
        return int.from_bytes(self.take(size), 'little')

    def text(self) -> str:
        """Return the next string; bytes that are not UTF-8 are told by their codes."""
        return self.take(self.number(4)).decode('utf-8', 'backslashreplace')

    def text_map(self) -> dict[str, str]:
        """
        Return the next map of strings.

        Returns
        -------
        dict of str to str
            In the order of the record.

        Raises
        ------
        BagError
            If the record ends before, or has too many of them.

        """
        end = self.number(4) + self.offset
        if end > len(self._data):
            raise BagError(f'a {self._what} record ends early')
        values: dict[str, str] = {}
        while self.offset < end:
            if len(values) >= limits.MAP_ENTRIES:
                raise BagError(
                    f'a {self._what} record has more than {limits.MAP_ENTRIES} entries')
            key = self.text()
            values[key] = self.text()
        return values


def read_header(data: bytes) -> tuple[str, str]:
    """Return profile and library of a header record's content."""
    fields = Fields(data, 'header')
    return fields.text(), fields.text()


def read_schema(data: bytes) -> Schema:
    """Return the schema of a record's content."""
    fields = Fields(data, 'schema')
    return Schema(fields.number(2), fields.text(), fields.text(), fields.take(fields.number(4)))


def read_channel(data: bytes) -> Channel:
    """Return the channel of a record's content."""
    fields = Fields(data, 'channel')
    return Channel(
        fields.number(2), fields.number(2), fields.text(), fields.text(), fields.text_map())


def read_metadata(data: bytes) -> tuple[str, dict[str, str]]:
    """Return name and values of a metadata record's content."""
    fields = Fields(data, 'metadata')
    return fields.text(), fields.text_map()


def read_chunk_head(data: bytes, length: int) -> ChunkHead:
    """
    Return what a chunk says of itself.

    Parameters
    ----------
    data : bytes
        Beginning of the record's content, 64 bytes or all of it.
    length : int
        Length of the whole content.

    Returns
    -------
    ChunkHead
        Checked against the length.

    Raises
    ------
    BagError
        If it is no chunk.

    """
    fields = Fields(data, 'chunk')
    start, end, size, crc = _CHUNK_HEAD.unpack(fields.take(_CHUNK_HEAD.size))
    compression = fields.text()
    data_length = fields.number(8)
    if fields.offset + data_length > length:
        raise BagError('a chunk record ends early')
    return ChunkHead(start, end, size, crc, compression, fields.offset, data_length)


def chunk_head(
        start: int, end: int, size: int, crc: int, compression: str, length: int) -> bytes:
    """Return a chunk record without its data, which has ``length`` bytes."""
    head = (_CHUNK_HEAD.pack(start, end, size, crc) + text(compression)
            + struct.pack('<Q', length))
    return PREFIX.pack(CHUNK, len(head) + length) + head


def decompress(data: bytes, compression: str, size: int) -> bytes:
    """
    Return the content of a chunk.

    Parameters
    ----------
    data : bytes
        As stored.
    compression : str
        ``''``, ``'lz4'`` or ``'zstd'``.
    size : int
        Length after decompression.

    Returns
    -------
    bytes
        Exactly ``size`` bytes.

    Raises
    ------
    BagError
        If the data are damaged or the compression is unknown.

    """
    if not compression:
        content = data
    elif compression == 'zstd':
        import zstandard
        try:
            # A frame may say its own size: believed only if it is what the chunk says. No more
            # memory than that is taken, whatever the data would unfold to.
            if zstandard.frame_content_size(data) not in (size, -1):
                raise BagError('a chunk does not decompress to the size it says')
            content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise BagError(f'a chunk does not decompress: {error}') from error
    elif compression == 'lz4':
        import lz4.frame
        try:
            content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        except RuntimeError as error:
            raise BagError(f'a chunk does not decompress: {error}') from error
    else:
        raise BagError(f'a chunk is compressed with {compression!r}: expected lz4 or zstd')
    if len(content) != size:
        raise BagError(f'a chunk has {len(content)} bytes of content: it says {size}')
    return content


def compress(data: bytes, compression: str, level: int) -> bytes:
    """
    Return the content of a chunk as it is stored.

    Parameters
    ----------
    data : bytes
        Content.
    compression : str
        ``''``, ``'lz4'`` or ``'zstd'``.
    level : int
        Of the compression.

    Returns
    -------
    bytes
        Compressed.

    Raises
    ------
    BagError
        If the compression is unknown.

    """
    if not compression:
        return data
    if compression == 'zstd':
        import zstandard
        packed: bytes = zstandard.ZstdCompressor(level=level).compress(data)
        return packed
    if compression == 'lz4':
        import lz4.frame
        framed: bytes = lz4.frame.compress(data, compression_level=level)
        return framed
    raise BagError(f'compression is {compression!r}: expected none, lz4 or zstd')
