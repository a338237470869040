"""Outcomes of a move or a request, and the error that contains one."""

from enum import Enum

from hmsa.errors import BadInputError


class Code(str, Enum):
    """
    The outcome of a move or a request; messages and files contain the value.

    The order is: feasible plans, refusals, outcomes of a request, and measured outcomes.
    """

    TWO_STEP = 'two_step'
    STEP = 'step'
    HOLD = 'hold'
    ROBUST = 'robust'
    MINIMAX = 'minimax'
    MINIMUM_TIME = 'minimum_time'
    MODAL = 'modal'
    SMOOTH = 'smooth'
    LINEAR = 'linear'
    TOO_DAMPED = 'too_damped'
    INDISTINGUISHABLE = 'indistinguishable'
    LEVELS = 'levels'
    PATH = 'path'

    OUT_OF_RANGE = 'out_of_range'
    FLUX_LIMIT = 'flux_limit'
    SLEW_LIMIT = 'slew_limit'
    SPELL_TOO_SHORT = 'spell_too_short'
    NO_TWO_STEP = 'no_two_step'
    NOT_CONVERGED = 'not_converged'
    BAD_INPUT = 'bad_input'
    UNKNOWN_JOINT = 'unknown_joint'
    NOT_INCREASING = 'not_increasing'
    IN_THE_PAST = 'in_the_past'
    TOO_LONG = 'too_long'
    NO_TIME = 'no_time'
    INACTIVE = 'inactive'
    SEVERAL_PLANNERS = 'several_planners'
    SEVERAL_PLANTS = 'several_plants'
    CLOCKS_DIFFER = 'clocks_differ'
    UNSEEN = 'unseen'
    UNHEARD = 'unheard'
    CUT_OFF = 'cut_off'
    INTERLOCK = 'interlock'

    NONE = 'none'
    WAITING = 'waiting'
    ACCEPTED = 'accepted'
    UNCHANGED = 'unchanged'
    SUPERSEDED = 'superseded'
    CORRECTED = 'corrected'
    REPLANNED = 'replanned'
    FEEDBACK_ENDED = 'feedback_ended'
    SATURATED = 'saturated'
    STOPPED = 'stopped'
    CLOCK_JUMPED = 'clock_jumped'

    ARRIVED = 'arrived'
    OFF_TARGET = 'off_target'
    VIBRATING = 'vibrating'
    LATE = 'late'
    MISSED = 'missed'
    UNDECIDED = 'undecided'
    UNOBSERVED = 'unobserved'

    def __str__(self) -> str:
        """Return the value."""
        return self.value


class RefusedError(BadInputError):
    """A request that cannot be carried out; the running plan continues. `code` is the reason."""

    def __init__(self, code: Code, reason: str) -> None:
        """Store the code with the message, which contains the value and the expectation."""
        super().__init__(reason)
        self.code = code
