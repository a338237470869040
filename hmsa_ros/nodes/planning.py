"""Parameters of the planner node, and what they mean for `hmsa_ros.core`."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any

from hmsa_ros.contract.parameters import FLUX_DENSITY_MAX, FLUX_DENSITY_MIN, SLEW_LIMIT
from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.core.planner import Options, Planner
from hmsa_ros.core.sequence import SHORT_SPELL
from hmsa_ros.core.shapers import SHAPERS
from hmsa_ros.core.timeline import Model
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes.joints import JointParameters, JOINTS
from hmsa_ros.nodes.managed import AUTOSTART
from hmsa_ros.nodes.marker_publisher import MARKER_SCALE
from hmsa_ros.nodes.parameters import (
    ACTUATOR,
    actuator_from,
    INITIAL_STRETCH,
    JOINT,
    ParameterSpec,
)
from hmsa_ros.runtime.records import Settings

_OPTIONS = Options()
_SETTINGS = Settings()

#: Parameters that a joint may have a value of its own for.
OWN = (
    *(replace(x, read_only=False) for x in ACTUATOR),
    INITIAL_STRETCH,
    ParameterSpec(
        'shaper', 'two_step', 'How a move is commanded.', choices=tuple(SHAPERS),
        read_only=False),
    ParameterSpec(
        'robust_order', 2, 'Number of chained two-step commands of the shaper robust.', '',
        1, 16, read_only=False),
    replace(SLEW_LIMIT, read_only=False),
    replace(FLUX_DENSITY_MIN, read_only=False),
    replace(FLUX_DENSITY_MAX, read_only=False),
)

SPECS = (
    *OWN,
    JOINT,
    JOINTS,
    ParameterSpec(
        'allow_partial_joints', _SETTINGS.allow_partial_joints,
        'Whether a trajectory may be for some of the joints; the others go on as planned.',
        read_only=False),
    ParameterSpec(
        'simultaneous_arrival', False,
        'Whether joints that would arrive at a setpoint before the slowest begin later, so that '
        'all arrive at the same time; one that is still moving is not held back.',
        read_only=False),
    ParameterSpec(
        'frame_id', 'coil', 'Frame of the coil in the stamped commands, and of the markers.'),
    MARKER_SCALE,
    ParameterSpec(
        'lead_time', _OPTIONS.lead_time / NANOSECONDS,
        'How far ahead of the time it applies a command is sent.', 's', 0.0, 1e6, read_only=False),
    ParameterSpec(
        'command_mode', 'continuous',
        'Whether commands are stamped with any time, or on the grid of command_period.',
        choices=('continuous', 'sampled')),
    ParameterSpec(
        'command_period', 0.001, 'Period of the grid in command_mode sampled.', 's',
        1e-9, 1e3),
    ParameterSpec(
        'max_points', _SETTINGS.max_points,
        'Largest number of setpoints in one trajectory, those of all joints together.', '',
        1, 10_000_000, read_only=False),
    ParameterSpec(
        'short_spell', _OPTIONS.short_spell,
        'What to do with a setpoint that ends before the move to it does.',
        choices=SHORT_SPELL, read_only=False),
    ParameterSpec(
        'heartbeat_period', _SETTINGS.heartbeat_period / NANOSECONDS,
        'How often the level in force is sent again, as a sign of life; 0 for never.', 's',
        0.0, 1e3, read_only=False),
    ParameterSpec(
        'replan_late', _SETTINGS.replan_late,
        'Whether the rest of a sequence is planned anew after a command has come late.',
        read_only=False),
    ParameterSpec(
        'lateness_tolerance', _SETTINGS.lateness_tolerance / NANOSECONDS,
        'How late a command may take effect without a new plan. The jitter of a good driver '
        'lies below the default, and what it leaves below the errors of any model.', 's',
        0.0, 1.0, read_only=False),
    ParameterSpec(
        'takeover_timeout', _SETTINGS.takeover_timeout / NANOSECONDS,
        'How long the first request waits for a sample of the state in force, if somebody '
        'publishes samples; 0 for not at all.', 's', 0.0, 60.0),
    ParameterSpec(
        'takeover_max_age', _SETTINGS.takeover_max_age / NANOSECONDS,
        'Age up to which such a sample counts.', 's', 0.0, 1e6),
    AUTOSTART,
)


def options_from(values: Mapping[str, Any]) -> Options:
    """
    Return the planning options that declared parameters describe.

    Parameters
    ----------
    values : mapping of str to object
        Of one joint.

    Returns
    -------
    Options
        In SI units.

    Raises
    ------
    BadInputError
        If the limits of the flux density are not in order.

    """
    least, largest = float(values['flux_density_min']), float(values['flux_density_max'])
    if not least < largest:
        raise BadInputError(
            f'parameter flux_density_min is {least:g} T: expected less than flux_density_max, '
            f'which is {largest:g} T')
    return Options(
        shaper=str(values['shaper']), short_spell=str(values['short_spell']),
        flux_density_min=least, flux_density_max=largest,
        lead_time=nanoseconds(values['lead_time']),
        period=0 if values['command_mode'] == 'continuous'
        else nanoseconds(values['command_period']),
        slew_limit=float(values['slew_limit']) or math.inf,
        order=int(values['robust_order']))


def nanoseconds(seconds: float) -> int:
    """Return a time in s in ns."""
    return round(float(seconds) * NANOSECONDS)


def settings_from(values: JointParameters) -> Settings:
    """Return how a runtime deals with time, as parameters for all joints say."""
    return Settings(
        **{x: nanoseconds(values[x]) for x in (
            'heartbeat_period', 'lateness_tolerance', 'takeover_timeout', 'takeover_max_age')},
        replan_late=bool(values['replan_late']), max_points=int(values['max_points']),
        allow_partial_joints=bool(values['allow_partial_joints']))


def group_from(parameters: JointParameters) -> PlannerGroup:
    """
    Return the planners that parameters describe.

    Parameters
    ----------
    parameters : JointParameters
        Of all joints.

    Returns
    -------
    PlannerGroup
        At rest.

    Raises
    ------
    BadInputError
        If a joint cannot be planned for.

    """
    planners = {}
    for name in parameters.names:
        values = parameters.of(name)
        planners[name] = _of(parameters, name, lambda values=values: Planner(
            actuator_from(values), options_from(values), stretch=values['initial_stretch']))
    return PlannerGroup(planners, simultaneous=parameters['simultaneous_arrival'])


def models_from(parameters: JointParameters, group: PlannerGroup) -> dict[str, Model]:
    """
    Return under which models planners are to go on.

    Parameters
    ----------
    parameters : JointParameters
        Of all joints.
    group : PlannerGroup
        As it is; it stays so.

    Returns
    -------
    dict of str to Model
        By joint, all of them checked.

    Raises
    ------
    BadInputError
        If one cannot be taken.

    """
    models = {}
    for name, planner in group.planners.items():
        values = parameters.of(name)
        models[name] = _of(
            parameters, name, lambda values=values, planner=planner:
            planner.checked_model(options_from(values), actuator_from(values)))
    return models


def _of(parameters: JointParameters, name: str, make: Any) -> Any:
    """Return what is made for a joint; an error names it if there are several."""
    try:
        return make()
    except BadInputError as error:
        if len(parameters.names) == 1:
            raise
        raise BadInputError(f'joint {name}: {error}') from error
