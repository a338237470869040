"""The codes of verdicts in words, for the reference; each code of the package has an entry."""

from collections.abc import Mapping

from hmsa.model.status import Code

#: What each code means and what to do about it.
EXPLANATIONS: Mapping[Code, tuple[str, str]] = {
    Code.TWO_STEP: ('The two-step command: beta_p until tau_p, then beta_1.', ''),
    Code.STEP: ('Holding level of the target, applied at once; the actuator rings.', ''),
    Code.HOLD: ('The actuator is already there and is held.', ''),
    Code.ROBUST: ('Cascaded two-step commands, which tolerate parameter errors.', ''),
    Code.MINIMAX: (
        'Levels that minimise the worst residual vibration for parameter errors within the given '
        'bounds.', ''),
    Code.MINIMUM_TIME: ('Maximum push, maximum brake, then the holding level.', ''),
    Code.MODAL: ('Levels after which all given modes are at rest.', ''),
    Code.SMOOTH: ('A continuous level along a smooth path of the stretch.', ''),
    Code.LINEAR: ('A linear input shaper, designed at the target; it leaves residual '
                  'vibration.', ''),
    Code.TOO_DAMPED: (
        'The actuator is too heavily damped to overshoot, so there is no two-step command. '
        'The plan is an unshaped step, which does not ring either.',
        'No action needed; the shaper minimum_time arrives sooner.'),
    Code.INDISTINGUISHABLE: (
        'So close to critical damping, beta_p and beta_1 agree to double precision; the '
        'plan is an unshaped step.',
        'No action needed; the shaper minimum_time arrives sooner.'),
    Code.LEVELS: ('Raw levels as sent, with rest at the end.', ''),
    Code.PATH: (
        'The plan follows a path with velocities (trajectory_mode: path). With WARN: limits of '
        'the coil prevent the actuator from following the path; the message contains the largest '
        'deviation.',
        'Slow the path down, or widen the limit that the message names.'),
    Code.OUT_OF_RANGE: (
        'The stretch is at or beyond a limit of the hyperelastic model: the full extension of the '
        'polymer chains (J_lim), where the force falls, or the end of a table.',
        'Choose a stretch inside the interval that the message names, or correct '
        'actuator.chain_limit.'),
    Code.FLUX_LIMIT: (
        'The move needs more flux density than the coil provides.',
        'Choose a nearer stretch, approach it in several setpoints, or widen flux_density_min '
        'and flux_density_max if the coil allows it.'),
    Code.SLEW_LIMIT: (
        'The amplifier ramps too slowly for a command that leaves no vibration.',
        'Raise slew_limit if the amplifier can do it, or choose a smaller move.'),
    Code.SPELL_TOO_SHORT: (
        'A setpoint is too short for the move to it.',
        'Give the setpoint at least the time that the message names, or set short_spell to '
        'continue, which plans the next move from the state reached by then.'),
    Code.NO_TWO_STEP: (
        'From this state of motion no two-step command leads to the target at rest.',
        'Wait until the actuator rests, or use the shaper minimum_time.'),
    Code.NOT_CONVERGED: (
        'The search for the plan did not converge.',
        "Check the actuator's parameters; if they are right, report the error with the request "
        'and the parameters.'),
    Code.BAD_INPUT: (
        'The request cannot be read: a number is not finite, or a field is missing or '
        'superfluous.',
        'Correct what the message names.'),
    Code.UNKNOWN_JOINT: (
        'The trajectory names joints that the planner does not have.',
        'Use the names in the parameters joint or joints of the planner.'),
    Code.NOT_INCREASING: (
        'The times of the points do not increase.',
        'Give each point a larger time_from_start than the one before.'),
    Code.IN_THE_PAST: (
        "By the planner's clock, the whole sequence is in the past.",
        'Use the clock of the planner for the timestamp: use_sim_time must agree on both sides. '
        'Timestamp 0 means now.'),
    Code.TOO_LONG: (
        'The trajectory has more setpoints than the parameter max_points allows.',
        'Send it in parts, each timestamped with its start, or raise max_points.'),
    Code.NO_TIME: (
        'The planner follows simulated time, and no message has arrived on /clock yet.',
        'Start the publisher of /clock, or set use_sim_time to false.'),
    Code.INACTIVE: (
        'The planner is a managed node and is not active, or was just deactivated.',
        'Activate it: ros2 lifecycle set /planner activate.'),
    Code.SEVERAL_PLANNERS: (
        'Several planners of one name run and would command the same joints.',
        'Stop all but one, or give each a namespace.'),
    Code.SEVERAL_PLANTS: (
        'Several plants or drivers move or measure one joint, such as a simulator beside the '
        'physical one: the samples do not belong to one actuator.',
        'Stop all but one of the nodes that the message names.'),
    Code.CLOCKS_DIFFER: (
        'The clocks of planner and plant, driver or sensor are too far apart for timestamps to be '
        'valid.',
        'Set the clocks of all hosts by one source, as with chrony; use_sim_time must agree on '
        'all sides.'),
    Code.UNSEEN: (
        'Samples have stopped while joint_states has a publisher: the actuator may not be where '
        'the planner predicts.',
        'Repair the sensor, or stop its publisher; without samples moves start as predicted.'),
    Code.UNHEARD: (
        'Commands do not arrive: the plant or driver has ended, or a link works in one direction '
        'only. After a stop: the stop was not acknowledged, so the planner cannot know whether '
        'the actuator rests.',
        'Start the plant or driver, or repair the network from the host of the planner to its '
        'host; then send the request again. After a stop, switch the coil off at the driver '
        'first.'),
    Code.CUT_OFF: (
        'The watchdog of plant or driver switched the coil off, or the hardware lost its state. '
        'The rest of the sequence was dropped.',
        'Send the request again: it starts from the current state. With after_cut_off resume the '
        'planner continues by itself.'),
    Code.INTERLOCK: (
        'The interlock of the driver is open, or its hardware is out of reach '
        '(`hardware.reconnect`): the coil is off, and the rest of the sequence was dropped.',
        'Close the interlock or plug the cable in, then send the request again. Nothing continues '
        'by itself.'),
    Code.NONE: ('No request has arrived yet.', ''),
    Code.WAITING: (
        'The request is accepted and starts as soon as the current state is known, and feedback '
        'has started.', ''),
    Code.ACCEPTED: ('The request is planned and is being executed.', ''),
    Code.UNCHANGED: ('The actuator is already moving there: the plan is unchanged.', ''),
    Code.SUPERSEDED: ('Another request arrived before this one was planned.', ''),
    Code.CORRECTED: ('The plan was corrected from samples (feedback: adapt).', ''),
    Code.REPLANNED: (
        'Commands did not take effect as planned, and the rest was planned again from the '
        'resulting state. Setpoints whose time had passed were left out; the message contains '
        'their number.',
        'Raise lead_time, or find out what delays or drops commands.'),
    Code.FEEDBACK_ENDED: (
        'Measured moves became worse with feedback: plans use the given parameters, in open loop.',
        'Check the sensor, then call ~/reset_estimate.'),
    Code.SATURATED: (
        'The amplifier did not reach a commanded level. Until the next request, the planner '
        'commands no level beyond the reached one, and plans the rest of the sequence within '
        'this limit.',
        'Set flux_density_max or flux_density_min to the limit of the amplifier.'),
    Code.STOPPED: (
        'With OK: the actuator has come to rest after a stop, which plant or driver has '
        'acknowledged. With ERROR: the planner brings the actuator to rest, because the rest of '
        'the sequence could not be planned again; the message gives the reason.',
        'Send the request again.'),
    Code.CLOCK_JUMPED: (
        'The clock was set. If simulated time went back, the plan was dropped; after a step of '
        'the clock of a host, it goes on as before.',
        'If the plan was dropped, send the request again. Synchronise clocks before the '
        'experiment, and have them slewed during it.'),
    Code.ARRIVED: (
        'Measured: the stretch rests at the setpoint, within the tolerances.', ''),
    Code.OFF_TARGET: (
        'Measured: the stretch rests farther from the setpoint than arrival_tolerance.',
        "Correct the actuator's parameters, as with hmsa identify, or raise the tolerance."),
    Code.VIBRATING: (
        'Measured: the stretch vibrates about the setpoint by more than vibration_tolerance.',
        "Correct the actuator's parameters, as with hmsa identify, or raise the tolerance."),
    Code.LATE: (
        'The actuator came to rest only after the end of the setpoint, because commands took '
        'effect late.',
        'Raise lead_time, or see what delays commands.'),
    Code.MISSED: (
        'The setpoint was not executed: a new plan left it out, or the plant or driver started '
        'after its commands were sent.',
        'Raise lead_time, or see what delays or drops commands; start plant or driver first.'),
    Code.UNDECIDED: (
        'Measured, but the samples show neither that the stretch rests within the tolerances nor '
        'that it does not.',
        'Hold the setpoint longer, or sample faster or with less noise, as the message says.'),
    Code.UNOBSERVED: (
        'Predicted, not measured: no valid samples arrived while the setpoint was held.',
        'Publish joint_states to have it measured; or repair the sensor that the message names.'),
}
