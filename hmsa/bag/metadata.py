"""
The file ``metadata.yaml`` of a bag, and the files of the bag: those that it lists, and no others.

Writes version 9 (Jazzy), reads versions 1 to 9. The recorder stores the parameters of nodes as
custom data under the node's full name, a dot and the parameter's name
(``/left/plant.actuator.density``), the value as JSON. Bags of version 0.1 have the last part of
the node's name only (``plant.actuator.density``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import os
from pathlib import Path
from typing import Any

import yaml

from hmsa.bag import limits, qos
from hmsa.errors import BadInputError, BagError

FILE_NAME = 'metadata.yaml'
VERSION = 9
# The start time that rosbag2 writes for a bag without messages.
NO_TIME = 9223372036854775807
#: Key of custom data while a bag is being written, which a killed writer leaves behind.
NOT_ENDED = 'hmsa_ros.not_ended'
_Dumper: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)

_Problem = Callable[[str], None]
_SUFFIXES = '.mcap', '.db3'
# Files that are often given in place of a bag: how they begin, and what to do.
_MISTAKEN = (
    (b'version https://git-lfs.github.com/', 'is a pointer of Git LFS in place of the file: '
     'expected a bag; fetch the file with "git lfs pull"'),
    (b'\x28\xb5\x2f\xfd', 'is compressed as a whole by zstd: expected the folder of the bag '
     f'with its {FILE_NAME}; or decompress it with "zstd -d FILE" and name the result'))


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag; ``metadata.yaml`` does not contain its definition."""

    name: str  #: for example ``'/joint_states'``
    type: str  #: for example ``'sensor_msgs/msg/JointState'``; empty if unknown
    definition: str = ''  #: with its dependencies; empty if unknown
    definition_encoding: str = 'ros2msg'  #: or ``'ros2idl'``, empty
    profiles: tuple[qos.Qos, ...] = ()  #: offered by the publishers
    type_hash: str = ''  #: RIHS01 hash; empty if unknown
    encoding: str = 'cdr'  #: of the messages
    message_count: int = 0  #: as the metadata say

    def check(self) -> None:
        """Raise `BadInputError` if name or type is empty."""
        if not self.name:
            raise BadInputError('a topic has an empty name: expected a name such as /stretch')
        if not self.type:
            raise BadInputError(f'topic {self.name} has an empty type: expected a message type')


@dataclass(frozen=True)
class FileMetadata:
    """One file of a bag: path in its folder, first log time and length in ns (see `NO_TIME`)."""

    path: str
    start_ns: int = NO_TIME
    duration_ns: int = 0
    message_count: int = 0


@dataclass(frozen=True)
class BagMetadata:
    """The content of ``metadata.yaml``."""

    start_ns: int = NO_TIME  #: first log time; `NO_TIME` without a message
    duration_ns: int = 0
    message_count: int = 0
    topics: tuple[BagTopic, ...] = ()
    files: tuple[FileMetadata, ...] = ()  #: in order of writing
    #: Notes of the user and the recorder.
    custom_data: Mapping[str, str] = field(default_factory=dict)
    ros_distro: str = 'jazzy'  #: that wrote it
    version: int = VERSION  #: of the file's layout
    storage: str = 'mcap'
    compression_mode: str = ''  #: of rosbag2 itself, none if empty; not MCAP's of chunks


def to_map(metadata: BagMetadata) -> dict[str, Any]:
    """Return metadata as dictionaries in rosbag2's order of keys, without the outer key."""
    return {
        'version': VERSION,
        'storage_identifier': metadata.storage,
        'duration': {'nanoseconds': metadata.duration_ns},
        'starting_time': {'nanoseconds_since_epoch': metadata.start_ns},
        'message_count': metadata.message_count,
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': topic.name,
                'type': topic.type,
                'serialization_format': topic.encoding,
                'offered_qos_profiles': qos.to_maps(topic.profiles),
                'type_description_hash': topic.type_hash,
            },
            'message_count': topic.message_count,
        } for topic in metadata.topics],
        'compression_format': '',
        'compression_mode': metadata.compression_mode,
        'relative_file_paths': [file.path for file in metadata.files],
        'files': [{
            'path': file.path,
            'starting_time': {'nanoseconds_since_epoch': file.start_ns},
            'duration': {'nanoseconds': file.duration_ns},
            'message_count': file.message_count,
        } for file in metadata.files],
        'custom_data': dict(metadata.custom_data) or None,
        'ros_distro': metadata.ros_distro,
    }


def to_yaml(metadata: BagMetadata, *, outer_key: bool = True) -> str:
    """Return metadata as YAML: with the outer key for the file, without for MCAP's record."""
    content = to_map(metadata)
    text: str = yaml.dump(
        {'rosbag2_bagfile_information': content} if outer_key else content, Dumper=_Dumper,
        sort_keys=False, allow_unicode=True, width=10**6)
    return text


def write(folder: Path, metadata: BagMetadata) -> None:
    """Replace a bag's metadata file in one step; on an OSError the old file is unchanged."""
    path = folder / FILE_NAME
    # Renaming is atomic: neither a reader nor a crash gets a partial file.
    temporary = folder / f'.{FILE_NAME}.new'
    try:
        with temporary.open('w', encoding='utf-8') as file:
            file.write(to_yaml(metadata))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read(path: Path) -> BagMetadata:
    """Read a file of version 1 to 9, with defaults for missing values, or raise `BagError`."""
    try:
        # In a foreign bag it may be a pipe, a device, or a link to one.
        if not path.is_file():
            raise BagError(f'{path} is no file: expected the metadata of a bag')
        with path.open('rb') as file:
            data = file.read(limits.YAML_SIZE + 1)
        text = data.decode('utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise BagError(f'{path} cannot be read: {error}') from error
    try:
        content = limits.load_yaml(text)
    except BagError as error:
        raise BagError(f'{path} cannot be used ({error}): expected the metadata of a '
                       'bag') from error
    if not isinstance(content, dict) or 'rosbag2_bagfile_information' not in content:
        raise BagError(f'{path} has no key rosbag2_bagfile_information: expected the metadata '
                       'of a bag')
    return from_map(content['rosbag2_bagfile_information'], str(path))


def from_map(content: Any, source: str) -> BagMetadata:
    """Read maps without the outer key, or raise a `BagError` that names their source."""
    try:
        version = int(content['version'])
        if version > VERSION:
            raise BagError(
                f'{source} is of version {version}: expected at most {VERSION}')
        topics = tuple(map(_topic, content['topics_with_message_count'] or ()))
        start = int(content['starting_time']['nanoseconds_since_epoch'])
        duration = int(content['duration']['nanoseconds'])
        count = int(content['message_count'])
        paths = [str(path) for path in content['relative_file_paths'] or ()]
        files = tuple(FileMetadata(
            str(entry['path']), int(entry['starting_time']['nanoseconds_since_epoch']),
            int(entry['duration']['nanoseconds']), int(entry['message_count']))
            for entry in content.get('files') or ())
        # Up to version 8 a path could carry the folder's name; it never leads out of it.
        return BagMetadata(
            start, duration, count, topics, files or tuple(map(FileMetadata, paths)),
            {str(key): str(value) for key, value in (content.get('custom_data') or {}).items()},
            str(content.get('ros_distro') or ''), version, str(content['storage_identifier']),
            str(content.get('compression_mode') or ''))
    except BagError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f'key {error} is missing' if isinstance(error, KeyError) else str(error)
        raise BagError(f'{source} cannot be understood ({what}): expected the metadata of a '
                       'bag') from error


def _topic(entry: Any) -> BagTopic:
    """Read one topic."""
    topic = entry['topic_metadata']
    return BagTopic(
        str(topic['name']), str(topic['type']),
        profiles=qos.from_stored(topic.get('offered_qos_profiles')),
        type_hash=str(topic.get('type_description_hash') or ''),
        encoding=str(topic['serialization_format']), message_count=int(entry['message_count']))


def advice_on(path: Path) -> str:
    """Return the kind of a file given instead of a bag, and the remedy; empty if it may be one."""
    if not path.is_file():
        return ''
    with path.open('rb') as file:
        begin = file.read(max(len(magic) for magic, _ in _MISTAKEN))
    table = 'is a table: expected a bag; hmsa identify and hmsa simulate read tables'
    return next((advice for magic, advice in _MISTAKEN if begin.startswith(magic)),
                table * (path.suffix.lower() == '.csv'))


def find_files(path: Path, problem: _Problem) -> tuple[list[Path], BagMetadata | None]:
    """
    Return the files of a bag (a folder or one file) in order, and its metadata.

    ``problem`` is called with a message about each inconsistency. Raises `BadInputError` if there
    is no bag, or its format is not supported.
    """
    try:
        if path.is_file():
            if path.name == FILE_NAME:
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
                problem(f'{FILE_NAME} does not name {entry.name}, which belongs to the '
                        'bag: read anyway')
            else:
                problem(f'{path} also contains {entry.name}, which {FILE_NAME} does not '
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
            f'{path} has no usable {FILE_NAME} and contains files of several bags '
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


def _metadata(folder: Path, problem: _Problem) -> BagMetadata | None:
    """Return the metadata; None if they are missing or unusable."""
    path = folder / FILE_NAME
    if not path.exists():
        problem(f'{path} is missing: the files themselves are read')
        return None
    try:
        if not _is_own(path, problem):
            raise BagError(f'{path} is no file of the bag')
        stored = read(path)
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
        folder: Path, stored: BagMetadata, problem: _Problem) -> list[Path]:
    """Return the existing files that the metadata list, each once."""
    found: dict[Path, None] = {}
    for file in stored.files:
        # Up to version 3, paths begin with the folder. A path never leads out of it.
        path = folder / Path(file.path.replace('\0', '')).name
        try:
            if _is_own(path, problem):
                found[path] = None
            elif not path.is_file():
                problem(f'{path} is missing, though {FILE_NAME} names it')
        except OSError as error:
            problem(f'{path} cannot be read: {error.strerror}')
    return list(found)


def _order(path: Path) -> tuple[str, int]:
    """Return a file's name without number and ending, and its number, by which files are read."""
    name = path.stem if path.suffix in _SUFFIXES else path.name
    stem, _, number = name.rpartition('_')
    return (stem, int(number)) if stem and number.isdecimal() else (name, -1)


def parameter_key(node: str, name: str) -> str:
    """Return the key of custom data for a parameter, as ``'/left/plant.actuator.density'``."""
    return f'{node}.{name}'


def node_parameters(custom_data: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return values as JSON by parameter, by node (full name; in bags of version 0.1 its end)."""
    # Every node has this parameter, and no other custom data end with it.
    nodes = {key.partition('.')[0] for key in custom_data if key.endswith('.use_sim_time')}
    result: dict[str, dict[str, str]] = {}
    for key, value in custom_data.items():
        node, _, name = key.partition('.')
        if node in nodes and name:
            result.setdefault(node, {})[name] = value
    return result


def recorded_parameters(custom_data: Mapping[str, str], node: str, space: str) -> dict[str, str]:
    """Return JSON values by parameter of a namespace's node, else of the only such node."""
    nodes = node_parameters(custom_data)
    exact = nodes.get(f'{space.rstrip("/")}/{node}')
    if exact is not None:
        return exact
    alike = [values for name, values in nodes.items() if name.rsplit('/', 1)[-1] == node]
    return alike[0] if len(alike) == 1 else {}
