"""
Show a bag in the Rerun viewer: ``python -m hmsa_ros.rerun_view BAG``.

Requires rerun-sdk (``pip install rerun-sdk``). Rerun reads stretch, rate and flux density from
MCAP files itself. It does not support markers, which are converted to boxes and arrows here.
`blueprint` defines the layout.
"""

import argparse
from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import sys
from typing import Any

import numpy as np

from hmsa_ros.bag.reader import BagReader, read_messages
from hmsa_ros.errors import BadInputError, complain, HmsaError
from hmsa_ros.interfaces import topics
from hmsa_ros.model.laws.coordinate import shared_name, STRETCH
from hmsa_ros.recordings.parameters import actuators, recorded

APPLICATION = 'hmsa_ros'
JOINT_STATES = topics.JOINT_STATES.name
MARKERS = tuple(
    topics.from_outside(topics.MARKERS.name, node) for node in topics.MARKERS.publishers)
#: Rerun's timeline of reception times.
TIMELINE = 'message_log_time'

# Constants of visualization_msgs, whose messages would need a ROS installation.
_ARROW, _CUBE, _TEXT, _TRIANGLES = 0, 1, 9, 11
_ADD, _DELETE, _DELETE_ALL = 0, 2, 3


def _rerun() -> Any:
    """Return the module rerun with its blueprints."""
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise BadInputError(
            f'rerun-sdk cannot be imported ({error}): expected it installed, for example by '
            'pip install rerun-sdk') from error
    return rerun


def _root(namespace: str) -> str:
    return f'/{namespace.strip("/")}'.rstrip('/')


def views(namespace: str = '', coordinate: str = STRETCH.name) -> dict[str, str]:
    """Return the entity path of each view by title, which contains the coordinate name."""
    root = _root(namespace)
    return {
        coordinate.capitalize(): f'{root}/{JOINT_STATES}/position',
        f'{coordinate.capitalize()} rate (1/s)': f'{root}/{JOINT_STATES}/velocity',
        'Flux density (T)': f'{root}/{JOINT_STATES}/effort',
        'Actuators': f'{root}/markers'}


def blueprint(namespace: str = '', coordinate: str = STRETCH.name) -> Any:
    """Return the layout of the viewer: actuators on the left, curves on the right."""
    rrb = _rerun().blueprint
    *curves, (title, path) = views(namespace, coordinate).items()
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin=path, name=title),
            rrb.Vertical(*(
                rrb.TimeSeriesView(origin=origin, name=name) for name, origin in curves)),
            column_shares=[2, 3]),
        rrb.TimePanel(timeline=TIMELINE, expanded=True),
        rrb.BlueprintPanel(expanded=False), rrb.SelectionPanel(expanded=False))


def show(bag: str | os.PathLike[str], recording: Any, namespace: str = '') -> None:
    """Log a bag and the blueprint; raise `BadInputError` if the namespace has no samples."""
    root = _root(namespace)
    reader = BagReader(bag)
    found = set(reader.topics)
    if f'{root}/{JOINT_STATES}' not in found:
        raise BadInputError(
            f'{os.fspath(bag)} has no topic {root}/{JOINT_STATES}: expected the namespace of '
            'the nodes in --namespace')
    recording.send_blueprint(blueprint(namespace, _coordinate(reader.custom_data, root)))
    for file in reader.files:
        recording.log_file_from_path(file)
    markers = [topic for name in MARKERS if (topic := f'{root}/{name}') in found]
    for message in read_messages(bag, markers) if markers else ():
        recording.set_time(TIMELINE, timestamp=np.datetime64(message.log_time_ns, 'ns'))
        for marker in message.message.markers:
            _log_marker(recording, views(namespace)['Actuators'], marker)


def _coordinate(custom_data: Mapping[str, str], root: str) -> str:
    """Return the coordinate name in a namespace, according to the recorded parameters."""
    parameters = recorded(custom_data, root)
    joints = next((x for node in (topics.PLANT, topics.PLANNER)
                   if isinstance(x := parameters.get(f'{node}.joints'), list) and x), [''])
    return shared_name(actuators(parameters, {}, str(x))[0].coordinate.name for x in joints)


def _log_marker(recording: Any, root: str, marker: Any) -> None:
    """Log a marker as a shape of Rerun."""
    rr = _rerun()
    if marker.action == _DELETE_ALL:
        recording.log(root, rr.Clear(recursive=True))
        return
    shape = rr.Clear(recursive=False) if marker.action == _DELETE else _shape(rr, marker)
    if shape is not None:
        recording.log(f'{root}/{marker.ns}/{marker.id}', shape)


def _shape(rr: Any, marker: Any) -> Any:
    """Return Rerun's shape of a marker; None if there is none."""
    colour = [round(255 * x) for x in (
        marker.color.r, marker.color.g, marker.color.b, marker.color.a)]
    position, scale, *points = (
        np.array([p.x, p.y, p.z]) for p in (marker.pose.position, marker.scale, *marker.points))
    if marker.type == _CUBE:
        return rr.Boxes3D(
            centers=[position], sizes=[scale], colors=[colour], fill_mode='solid')
    if marker.type == _ARROW and len(points) == 2:
        return rr.Arrows3D(
            origins=points[:1], vectors=[points[1] - points[0]], radii=[scale[0] / 2],
            colors=[colour])
    if marker.type == _TRIANGLES:
        corners = position + points
        # Without normals, there is no shading.
        a, b, c = corners[0::3], corners[1::3], corners[2::3]
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        return rr.Mesh3D(
            vertex_positions=corners, vertex_normals=np.repeat(normals, 3, axis=0),
            albedo_factor=colour)
    if marker.type == _TEXT:
        return rr.Points3D([position], radii=[0.0], labels=[marker.text], colors=[colour])
    return None


def main(args: Sequence[str] | None = None) -> int:
    """Show a bag, or save it; return 0, 1 if it cannot be read, or 2 for bad arguments."""
    parser = argparse.ArgumentParser(
        prog='python -m hmsa_ros.rerun_view', description='Show a bag in the Rerun viewer.',
        epilog='Example: python -m hmsa_ros.rerun_view my_run')
    parser.add_argument('bag', metavar='BAG', help='folder of the bag')
    parser.add_argument(
        '--namespace', default='', metavar='NAME', help='namespace of the nodes')
    parser.add_argument(
        '--save', type=Path, metavar='FILE.rrd',
        help='write a recording of Rerun instead of starting the viewer')
    given = parser.parse_args(args)
    try:
        recording = _rerun().RecordingStream(APPLICATION)
        if given.save is not None:
            recording.save(given.save)
        else:
            recording.spawn()
        show(given.bag, recording, given.namespace)
        recording.flush()
        if given.save is not None:
            # Disconnecting writes the index of the file.
            recording.disconnect()
    except HmsaError as error:
        return complain(error)
    return 0


if __name__ == '__main__':
    sys.exit(main())
