"""Parameters of the planner node, and their conversion for `hmsa.planning`."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
import math
from typing import Any

from hmsa.errors import BadInputError
from hmsa.identification.files import errors_from
from hmsa.identification.quantities import check_free, Known
from hmsa.interfaces import parameters as shared
from hmsa.interfaces.actuator import planned_from
from hmsa.interfaces.parameters import LAW_NAME, ParameterSpec
from hmsa.judge.records import Tolerances
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import SHORT_SPELL
from hmsa.planning.shapers import SHAPERS
from hmsa.planning.shapers.request import (
    ERRORS,
    LARGEST_ERROR,
    LEAST_PERIODS,
    MOST_ORDER,
    MOST_PERIODS,
    SmoothLimits,
)
from hmsa.planning.timeline import JointModel
from hmsa_ros.nodes.managed import AUTOSTART
from hmsa_ros.nodes.markers import MARKER_SCALE
from hmsa_ros.nodes.parameters import JointParameters, JOINTS
from hmsa_ros.runtime.records import (
    AFTER_CUT_OFF,
    FEEDBACK_MODES,
    Settings,
    TRAJECTORY_MODES,
)

_OPTIONS = Options()
_SETTINGS = Settings()
_changeable = partial(ParameterSpec, read_only=False)

#: Parameters that may have a separate value for each joint.
OWN = (
    *(replace(x, read_only=x.name in shared.FIXED) for x in shared.BLOCK),
    shared.INITIAL_STRETCH,
    _changeable(
        'shaper', 'two_step', 'Shaper that plans each move.', choices=tuple(SHAPERS)),
    _changeable(
        'robust_order', 2,
        'Number of two-step commands that the shaper robust cascades. For a block with secondary '
        'modes, modal takes as many half periods of the first mode; for a beam, each above 2 adds '
        'half a period.', '', 1, MOST_ORDER),
    _changeable(
        'minimax_errors', list(ERRORS),
        'Relative errors in shear modulus, damping coefficient and J_lim for which the shaper '
        'minimax minimises the worst residual vibration; it takes as long as robust.', '',
        0.0, LARGEST_ERROR, items=float),
    _changeable(
        'minimax_file', '',
        'File of hmsa identify --out: the shaper minimax plans for the ellipsoid of its '
        'covariance, and minimax_errors apply to parameters that were not identified; empty for '
        'none.'),
    _changeable(
        'smooth_periods', _OPTIONS.pace.periods,
        'Minimum duration of a move of the shaper smooth in natural periods; limits of flux '
        'density, slew rate or stretch rate extend it.', '', LEAST_PERIODS, MOST_PERIODS),
    _changeable(
        'stretch_rate_max', 0.0,
        'Maximum stretch rate of the shaper smooth; 0 for any.', '1/s', 0.0, 1e12),
    *(replace(x, read_only=False) for x in (
        shared.SLEW_LIMIT, shared.COIL_TIME_CONSTANT, *shared.VISCOELASTIC,
        shared.CREEP_TOLERANCE)),
    _changeable(
        'path_tolerance', _OPTIONS.path_tolerance,
        'Maximum deviation from a path (trajectory_mode path) as a fraction of its range; a '
        'smaller value needs more levels, in proportion to its cube root.', '', 1e-9, 1.0),
    *(replace(x, read_only=False) for x in (shared.FLUX_DENSITY_MIN, shared.FLUX_DENSITY_MAX)),
    *shared.KNOWN,
)

PARAMETERS = (
    *OWN,
    shared.JOINT,
    JOINTS,
    _changeable(
        'allow_partial_joints', _SETTINGS.allow_partial_joints,
        'Whether a trajectory may name only some of the joints; the others continue as planned.'),
    _changeable(
        'simultaneous_arrival', False,
        'Whether faster joints start a move later so that all joints arrive at the same time; a '
        'joint that is still moving is not delayed.'),
    ParameterSpec(
        'frame_id', 'coil', 'Frame of the coil, in commands and markers.'),
    MARKER_SCALE,
    _changeable(
        'lead_time', _OPTIONS.lead_time / NANOSECONDS,
        'Interval by which a command is sent ahead of its '
        'timestamp.', 's', 0.0, 1e6),
    ParameterSpec(
        'command_mode', 'continuous',
        'Times at which commands may apply: any time, or only the grid of command_period.',
        choices=('continuous', 'sampled')),
    ParameterSpec(
        'command_period', 0.001, 'Grid period in command_mode sampled.', 's', 1e-9, 1e3),
    _changeable(
        'max_points', _SETTINGS.max_points,
        'Largest number of setpoints in one trajectory, summed over its joints.', '',
        1, 10_000_000),
    _changeable(
        'trajectory_mode', _SETTINGS.trajectory_mode,
        'What to do with a trajectory that has velocities: refuse it, since the actuator comes to '
        'rest at each point, or follow it as a path; without velocities, each point is a rest.',
        choices=TRAJECTORY_MODES),
    _changeable(
        'short_spell', _OPTIONS.short_spell,
        'What to do if a setpoint is too short for its move: refuse the request, or continue to '
        'the next setpoint from the state reached.', choices=SHORT_SPELL),
    _changeable(
        'heartbeat_period', _SETTINGS.heartbeat_period / NANOSECONDS,
        'Heartbeat: period at which the current level is sent again; 0 for never.', 's', 0.0, 1e3),
    _changeable(
        'replan_late', _SETTINGS.replan_late,
        'Whether to plan the rest of a sequence again after a late command, if that leaves less '
        'vibration.'),
    _changeable(
        'lateness_tolerance', _SETTINGS.lateness_tolerance / NANOSECONDS,
        'Lateness of a command that never counts; more counts by the vibration that it leaves.',
        's', 0.0, 1.0),
    _changeable(
        'arrival_tolerance', _SETTINGS.tolerances.arrival,
        'Maximum steady-state error of an arrived setpoint, as a fraction of the '
        'step.', '', 0.0, 1e3),
    _changeable(
        'vibration_tolerance', _SETTINGS.tolerances.vibration,
        'Maximum residual vibration, peak to peak, as a fraction of the step.', '', 0.0, 1e3),
    _changeable(
        'stretch_tolerance', _SETTINGS.tolerances.stretch,
        'Steady-state error and residual vibration that are tolerated for any step.', '',
        0.0, 1e3),
    _changeable(
        'feedback', _SETTINGS.feedback,
        'Use of the samples on joint_states: off; observe estimates the parameters and publishes '
        'them on ~/estimate; adapt also corrects plans, and plans with the estimate; cautious '
        'also extends moves whose predicted error exceeds feedback_tolerance, to correct them on '
        'the way: three times (five times for six estimated parameters, and up to twice that for '
        'large noise).', choices=FEEDBACK_MODES),
    ParameterSpec(
        'feedback_parameters', list(_SETTINGS.feedback_parameters),
        'Parameters that feedback estimates: shear_modulus, damping_coefficient, '
        'stretch_bias, remanence, chain_limit, coil_time_constant and others of hmsa identify.'),
    _changeable(
        'feedback_cautious', _SETTINGS.feedback_cautious,
        'Whether feedback adapt is the same as feedback cautious.'),
    _changeable(
        'feedback_tolerance', _SETTINGS.feedback_tolerance,
        'Predicted error (vibration amplitude plus steady-state error, as a fraction of the step) '
        'above which feedback cautious extends a move.', '', 0.0, 1.0),
    _changeable(
        'feedback_trim', _SETTINGS.feedback_trim,
        'Maximum change of a holding level by which feedback adapt compensates a constant force, '
        'in small moves; constant_force must be among '
        'feedback_parameters.', 'T', 0.0, 10.0),
    _changeable(
        'feedback_frozen', _SETTINGS.feedback_frozen,
        'Whether feedback keeps its estimate of the parameters and estimates the state '
        'only.'),
    _changeable(
        'feedback_file', _SETTINGS.feedback_file,
        'Parameter file to which ~/save_estimate writes the estimate.'),
    _changeable(
        'after_cut_off', _SETTINGS.after_cut_off,
        'Reaction to a cut-off of the coil: drop the rest of the sequence and wait for a request, '
        'or resume it with a shaped move from the current state.', choices=AFTER_CUT_OFF),
    ParameterSpec(
        'takeover_timeout', _SETTINGS.takeover_timeout / NANOSECONDS,
        'Time that the first request waits for a plant or driver and, if samples are published, '
        'for a sample of the current state; later requests wait for samples that have stopped. 0 '
        'for no wait.', 's', 0.0, 60.0),
    ParameterSpec(
        'takeover_max_age', _SETTINGS.takeover_max_age / NANOSECONDS,
        'Maximum age of that sample.', 's', 0.0, 1e6),
    _changeable(
        'temperature_max_age', _SETTINGS.temperature_max_age / NANOSECONDS,
        'Age of the newest temperature from which status and log name it; plans continue from '
        'it.', 's', 0.0, 1e6),
    AUTOSTART,
)


def options_from(values: Mapping[str, Any]) -> Options:
    """
    Return the planning options described by the parameters of a joint.

    Raises
    ------
    BadInputError
        If the minimum flux density is not below the maximum.

    """
    least, largest = values['flux_density_min'], values['flux_density_max']
    if not least < largest:
        raise BadInputError(
            f'parameter flux_density_min is {least:g} T: expected less than flux_density_max, '
            f'which is {largest:g} T')
    plain: dict[str, Any] = {x: values[x] for x in (
        'shaper', 'short_spell', 'flux_density_min', 'flux_density_max', 'coil_time_constant',
        'creep_tolerance', 'path_tolerance')}
    return Options(
        **plain, lead_time=_nanoseconds(values['lead_time']),
        period=0 if values['command_mode'] == 'continuous'
        else _nanoseconds(values['command_period']),
        slew_limit=values['slew_limit'] or math.inf, order=values['robust_order'],
        errors=errors_from(values['minimax_file'], values['minimax_errors']),
        pace=SmoothLimits(values['smooth_periods'], values['stretch_rate_max'] or math.inf))


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


def settings_from(values: JointParameters) -> Settings:
    """
    Return the settings of a runtime described by the parameters for all joints.

    Raises
    ------
    BadInputError
        If a name of feedback_parameters is unknown, or feedback is to correct a beam that has
        secondary modes.

    """
    plain: dict[str, Any] = {x: values[x] for x in (
        'trajectory_mode', 'replan_late', 'after_cut_off', 'max_points', 'allow_partial_joints',
        'feedback', 'feedback_cautious', 'feedback_tolerance', 'feedback_trim', 'feedback_frozen',
        'feedback_file')}
    modal = [x for x, y in values.each(
        lambda _, own: own['modes.frequency_ratio'] and own[LAW_NAME.name] == 'beam').items() if y]
    if modal and values['feedback'] in ('adapt', 'cautious'):
        raise BadInputError(
            f'parameter feedback is {values["feedback"]} and {modal[0]} is a beam with modes.*: '
            'expected observe or off, since feedback does not support secondary modes of a beam; '
            'hmsa identify fits them to a recording, and hmsa learn corrects a sequence by its '
            'repeats')
    times: dict[str, Any] = {x: _nanoseconds(values[x]) for x in (
        'heartbeat_period', 'lateness_tolerance', 'takeover_timeout', 'takeover_max_age',
        'temperature_max_age')}
    return Settings(
        **plain, **times,
        feedback_parameters=_free(values),
        known=values.each(lambda _, own: Known.read(own)),
        tolerances=Tolerances(*(values[f'{x}_tolerance'] for x in (
            'arrival', 'vibration', 'stretch'))))


def _free(values: JointParameters) -> tuple[str, ...]:
    try:
        return check_free(values['feedback_parameters'])
    except BadInputError as error:
        raise BadInputError(f'parameter feedback_parameters: {error}') from error


def group_from(values: JointParameters) -> PlannerGroup:
    """Return planners described by parameters, at rest; raise `BadInputError` if impossible."""
    planners = values.each(lambda _, own: Planner(
        planned_from(own), options_from(own), stretch=own['initial_stretch']))
    return PlannerGroup(planners, simultaneous=values['simultaneous_arrival'])


def models_from(values: JointParameters, group: PlannerGroup) -> dict[str, JointModel]:
    """Return the checked models that parameters describe, by joint; the planners do not change."""
    return values.each(lambda name, own: group.planners[name].checked_model(
        options_from(own), planned_from(own)))
