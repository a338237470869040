"""Find the files of a bag: those that its metadata list, and no others."""

from collections.abc import Callable
from pathlib import Path

from hmsa.bag import metadata
from hmsa.errors import BadInputError, BagError

_Problem = Callable[[str], None]


_SUFFIXES = '.mcap', '.db3'
# Files that are often given in place of a bag: how they begin, and what to do.
_MISTAKEN = (
    (b'version https://git-lfs.github.com/', 'is a pointer of Git LFS in place of the file: '
     'expected a bag; fetch the file with "git lfs pull"'),
    (b'\x28\xb5\x2f\xfd', 'is compressed as a whole by zstd: expected the folder of the bag '
     f'with its {metadata.FILE_NAME}; or decompress it with "zstd -d FILE" and name the result'))


def advice_on(path: Path) -> str:
    """Return the kind of a file given instead of a bag, and the remedy; empty if it may be one."""
    if not path.is_file():
        return ''
    with path.open('rb') as file:
        begin = file.read(max(len(magic) for magic, _ in _MISTAKEN))
    table = 'is a table: expected a bag; hmsa identify and hmsa simulate read tables'
    return next((advice for magic, advice in _MISTAKEN if begin.startswith(magic)),
                table * (path.suffix.lower() == '.csv'))


def find(path: Path, problem: _Problem) -> tuple[list[Path], metadata.BagMetadata | None]:
    """
    Return the files of a bag (a folder or one file) in order, and its metadata.

    ``problem`` is called with a message about each inconsistency. Raises `BadInputError` if there
    is no bag, or its format is not supported.
    """
    try:
        if path.is_file():
            if path.name == metadata.FILE_NAME:
                raise BadInputError(f'{path} describes a bag: expected its folder, {path.parent}')
            return [path], None
        if not path.is_dir():
            what = 'is neither' if path.exists() else 'does not exist'
            raise BadInputError(
                f'{path} {what}: expected the folder of a bag or an .mcap or .db3 file')
        entries = sorted(path.iterdir(), key=_order)
        present = [x for x in entries if x.suffix in _SUFFIXES and _is_own(x, problem)]
        stored = _metadata(path, problem)
        if stored is not None and stored.compression_mode.upper() not in ('', 'NONE'):
            # As a whole by rosbags, which follows links.
            if links := [x for x in entries if x.is_symlink()]:
                raise BadInputError(f'{path} is compressed and contains the link {links[0].name}: '
                                    'expected files')
            return [path], stored
        listed = [] if stored is None else _listed(path, stored, problem)
    except OSError as error:
        raise BadInputError(
            f'{path} cannot be read ({error.strerror}): expected a bag') from error
    if listed:
        for entry in present:
            if entry in listed:
                continue
            # A crash leaves the last split unlisted; anything else is another bag.
            if _order(entry)[0] == _order(listed[0])[0]:
                listed.append(entry)
                problem(f'{metadata.FILE_NAME} does not name {entry.name}, which belongs to the '
                        'bag: read anyway')
            else:
                problem(f'{path} also contains {entry.name}, which {metadata.FILE_NAME} does not '
                        'name: skipped')
        return listed, stored
    if not present:
        for entry in entries:
            if advice := advice_on(entry):
                raise BadInputError(f'{entry} {advice}')
        inside = sorted({x.parent for suffix in _SUFFIXES for x in path.glob(f'*/*{suffix}')}
                        | set(path.glob('*.bag')))
        links = [x for x in entries if x.suffix in _SUFFIXES and x.is_file()]
        raise BadInputError(f'{path} contains no .mcap or .db3 file: expected a bag' + (
            f', such as {inside[0]}' if inside else
            f'; name {links[0]}, a link out of the folder, to read it' if links else ''))
    stems = dict.fromkeys(_order(x)[0] for x in present)
    if len(stems) > 1:
        raise BadInputError(
            f'{path} has no usable {metadata.FILE_NAME} and contains files of several bags '
            f'({", ".join(stems)}): expected one bag; name one of its files')
    return present, stored


def _is_own(path: Path, problem: _Problem) -> bool:
    """Return whether a path is a file in its folder, not a link to another folder."""
    if not path.is_file():
        return False
    if path.resolve().parent != path.parent.resolve():
        problem(f'{path} is a link to {path.resolve()}, out of the folder of the bag: skipped; '
                'name that file to read it')
        return False
    return True


def _metadata(folder: Path, problem: _Problem) -> metadata.BagMetadata | None:
    """Return the metadata; None if they are missing or unusable."""
    path = folder / metadata.FILE_NAME
    if not path.exists():
        problem(f'{path} is missing: the files themselves are read')
        return None
    try:
        if not _is_own(path, problem):
            raise BagError(f'{path} is no file of the bag')
        stored = metadata.read(path)
    except BagError as error:
        problem(f'{error}; the files themselves are read')
        return None
    # "ros2 bag reindex" leaves no storage.
    if stored.storage not in ('', 'mcap', 'sqlite3'):
        raise BadInputError(
            f'{folder} is stored as {stored.storage!r}: expected mcap or sqlite3; convert it with '
            '"ros2 bag convert"')
    return stored


def _listed(
        folder: Path, stored: metadata.BagMetadata, problem: _Problem) -> list[Path]:
    """Return the existing files that the metadata list, each once."""
    found: dict[Path, None] = {}
    for file in stored.files:
        # Up to version 3, paths begin with the folder. A path never leads out of it.
        path = folder / Path(file.path.replace('\0', '')).name
        try:
            if _is_own(path, problem):
                found[path] = None
            elif not path.is_file():
                problem(f'{path} is missing, though {metadata.FILE_NAME} names it')
        except OSError as error:
            problem(f'{path} cannot be read: {error.strerror}')
    return list(found)


def _order(path: Path) -> tuple[str, int]:
    """Return a file's name without number and ending, and its number, by which files are read."""
    name = path.stem if path.suffix in _SUFFIXES else path.name
    stem, _, number = name.rpartition('_')
    return (stem, int(number)) if stem and number.isdecimal() else (name, -1)
