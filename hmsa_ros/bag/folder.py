"""The files of a bag: those that its metadata name, and no others."""

from pathlib import Path
import re

from hmsa_ros.bag import metadata
from hmsa_ros.bag.intake import Problems
from hmsa_ros.errors import BadInputError, BagError


class Folder:
    """
    A folder with a bag, or one file; ``problems`` gets what cannot be read or does not agree.

    ``metadata`` is what ``metadata.yaml`` says, once the files have been found, or None.
    """

    def __init__(self, path: Path, problems: Problems) -> None:
        self._path = path
        self._problems = problems
        self.metadata: metadata.BagMetadata | None = None

    def find(self) -> list[Path]:
        """Return the files of the bag in order, or raise `BadInputError` if there is none."""
        path = self._path
        try:
            if path.is_file():
                if path.name == metadata.FILE_NAME:
                    raise BadInputError(
                        f'{path} describes a bag: expected its folder, {path.parent}')
                return [path]
            if not path.is_dir():
                what = 'is neither' if path.exists() else 'does not exist'
                raise BadInputError(
                    f'{path} {what}: expected the folder of a bag or an .mcap file')
            present = sorted(
                (entry for entry in path.iterdir()
                 if entry.name.endswith('.mcap') and self._is_own(entry)),
                key=_file_order)
        except OSError as error:
            raise BadInputError(
                f'{path} cannot be read ({error.strerror}): expected a bag') from error
        listed = self._listed_files()
        if listed:
            extra = [entry.name for entry in present if entry not in listed]
            if extra:
                # A crash leaves the last split unlisted; anything else is another bag.
                own = [entry for entry in present
                       if entry in listed or _stem(entry) == _stem(listed[0])]
                other = [entry.name for entry in present if entry not in own]
                if other:
                    self._problems.add(
                        f'{path} also holds {", ".join(other)}, which {metadata.FILE_NAME} does '
                        'not name: skipped')
                missing = [entry.name for entry in own if entry not in listed]
                if missing:
                    self._problems.add(
                        f'{metadata.FILE_NAME} does not name {", ".join(missing)}, which '
                        'belongs to the bag: read anyway')
                return own
            return listed
        if not present:
            others = sorted(entry.name for entry in path.iterdir() if entry.suffix == '.db3')
            if others:
                raise BadInputError(
                    f'{path} holds an SQLite bag ({others[0]}): expected MCAP; convert it with '
                    '"ros2 bag convert"')
            inside = sorted(x.parent.name for x in path.glob('*/*.mcap'))
            raise BadInputError(f'{path} holds no .mcap file: expected a bag' + (
                f', such as {path / inside[0]}' if inside else ''))
        stems = sorted({_stem(entry) for entry in present})
        if len(stems) > 1:
            raise BadInputError(
                f'{path} has no usable {metadata.FILE_NAME} and holds files of several bags '
                f'({", ".join(stems)}): expected one bag; name one .mcap file')
        return present

    def _is_own(self, entry: Path) -> bool:
        """Return whether an entry of the folder is a file that lies in it."""
        if not entry.is_file():
            return False
        if entry.resolve().parent != self._path.resolve():
            self._problems.add(
                f'{entry} is a link to {entry.resolve()}, out of the folder of the bag: '
                'skipped; name that file to read it')
            return False
        return True

    def _listed_files(self) -> list[Path]:
        """Return the files that the metadata name and that are there."""
        path = self._path / metadata.FILE_NAME
        if not path.exists():
            self._problems.add(f'{path} is missing: the files themselves are read')
            return []
        try:
            if not self._is_own(path):
                raise BagError(f'{path} is no file of the bag')
            self.metadata = metadata.read(path)
        except BagError as error:
            self._problems.add(f'{error}; the files themselves are read')
            return []
        if self.metadata.storage != 'mcap':
            raise BadInputError(
                f'{self._path} is stored as {self.metadata.storage!r}: expected mcap; convert it '
                'with "ros2 bag convert"')
        if self.metadata.compression_mode.upper() not in ('', 'NONE'):
            raise BadInputError(
                f'{self._path} is compressed by rosbag2 in mode '
                f'{self.metadata.compression_mode}: expected MCAP with compressed chunks; '
                'convert it with "ros2 bag convert"')
        found: dict[Path, None] = {}
        for file in self.metadata.files:
            # Up to version 3 paths begin with the folder; none leads out of it.
            candidate = self._path / Path(file.path.replace('\0', '')).name
            try:
                if self._is_own(candidate):
                    found[candidate] = None
                elif not candidate.is_file():
                    self._problems.add(
                        f'{candidate} is missing, though {metadata.FILE_NAME} names it')
            except OSError as error:
                self._problems.add(f'{candidate} cannot be read: {error.strerror}')
        return list(found)


def _stem(path: Path) -> str:
    """Return a file's name without number and ending."""
    return re.sub(r'(_\d+)?\.mcap$', '', path.name)


def _file_order(path: Path) -> tuple[str, int]:
    """Sort by name, then by number."""
    match = re.search(r'_(\d+)\.mcap$', path.name)
    return _stem(path), int(match[1]) if match else -1


