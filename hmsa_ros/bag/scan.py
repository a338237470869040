"""What a file of a bag holds: by its summary, or else record by record."""

from dataclasses import replace
import os
from pathlib import Path
import zlib

from hmsa_ros.bag import limits
from hmsa_ros.bag.intake import Intake, ScannedFile
from hmsa_ros.bag.records import MAGIC
from hmsa_ros.bag.summary import read_summary
from hmsa_ros.bag.walk import walk
from hmsa_ros.errors import BadInputError

_CRC_BYTES = 2**20


def scan(intake: Intake, path: Path, number: int) -> ScannedFile:
    """Find out what a file holds; raise `BadInputError` if it is no MCAP file."""
    try:
        with path.open('rb') as stream:
            size = os.fstat(stream.fileno()).st_size
            if size == 0:
                raise BadInputError(f'{path} is empty: expected an MCAP file')
            magic = stream.read(len(MAGIC))
            if magic != MAGIC:
                if MAGIC.startswith(magic):
                    raise BadInputError(
                        f'{path} was cut off after {size} bytes: expected an MCAP file')
                raise BadInputError(f'{path} is not an MCAP file: it begins with '
                                    f'{magic!r}, expected {MAGIC!r}')
            descriptor = stream.fileno()
            file = ScannedFile(path, number, size, intake)
            if not read_summary(descriptor, file):
                file = replace(
                    file, schemas={}, channels={}, blocks=[], metadata={}, counts={})
                walk(descriptor, file)
            return file
    except OSError as error:
        raise BadInputError(
            f'{path} cannot be read ({error.strerror}): expected an MCAP file') from error


def check_data(file: ScannedFile) -> None:
    """Hold the data of a file against their CRC, unless that would take long."""
    crc, offset = 0, 0
    if not file.data_crc or file.damaged or file.data_end > limits.CHECKED_SIZE:
        return
    with file.path.open('rb') as stream:
        while offset < file.data_end:
            data = stream.read(min(_CRC_BYTES, file.data_end - offset))
            if not data:
                break
            crc = zlib.crc32(data, crc)
            offset += len(data)
    if crc != file.data_crc:
        file.problem(' is damaged: the CRC of its data differs')
