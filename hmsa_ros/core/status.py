"""Verdicts on a move or on a request, and the error that carries one."""

from enum import Enum

from hmsa_ros.errors import BadInputError


class Code(str, Enum):
    """
    What became of a move or a request; the value is what messages and files carry.

    The first eight are plans that can be carried out, the others refusals.
    """

    TWO_STEP = 'two_step'
    STEP = 'step'
    HOLD = 'hold'
    ROBUST = 'robust'
    MINIMUM_TIME = 'minimum_time'
    LINEAR = 'linear'
    TOO_DAMPED = 'too_damped'
    INDISTINGUISHABLE = 'indistinguishable'

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
    NO_TIME = 'no_time'

    def __str__(self) -> str:
        """Return the value."""
        return self.value


class RefusedError(BadInputError):
    """
    A request that cannot be carried out; whatever ran before runs on.

    Attributes
    ----------
    code : Code
        Why.

    """

    def __init__(self, code: Code, reason: str) -> None:
        """
        Keep the code beside the sentence.

        Parameters
        ----------
        code : Code
            Why.
        reason : str
            One sentence: what, got, expected.

        """
        super().__init__(reason)
        self.code = code
