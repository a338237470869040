"""When an estimate is acted upon, and which parameters plans use where it is not."""

from hmsa_ros.estimation import Estimator
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.timeline import Model, Plan

# So many updates in a row whose samples do not fit call for a new beginning.
_PERSISTENT = 3
# Units of time of a motion, and samples of it, that have to fit before an estimate counts.
_SHOWN, _FEWEST = 6.0, 10
# Share of the samples of a move that may be rejected.
_REJECTED = 0.1
# What a move may leave, as a share of its step, that confirms the parameters it was planned with.
_CONFIRMS = 0.02


class Trust:
    """
    Follows how samples of one joint fit.

    An estimate counts once a whole move has fitted, or at once if asked for. Where samples do not
    fit, plans use the parameters that a move has confirmed last, or those given; where that lasts,
    the estimator begins anew.
    """

    def __init__(self, begin: int, *, at_once: bool) -> None:
        # That a move was planned with which arrived as measured.
        self.confirmed: Model | None = None
        self.beginnings = 0  # new ones
        self.acts = at_once
        self.why = ''  # for which samples are not trusted; empty where they are
        self.ended = False  # whether moves got worse by what was learnt
        self._begin, self._doubts, self._rejected = begin, 0, 0
        # Estimates that moves had shown to fit, and which did not after all; moves still to fit.
        self._failures, self._moves = 0, 1

    def doubt(self, why: str, now: int, *, at_once: bool = False) -> bool:
        """Take in that samples do not fit at a time in ns; return whether to begin anew."""
        if self.ended:
            return False
        self.why = why
        self._doubts += 1
        if self.acts and self._doubts < _PERSISTENT and not at_once:
            return False
        self._failures += self.acts
        if self._failures > 1:
            # Each time more has to be shown.
            self.confirmed = None
        self.beginnings += 1
        self.acts, self._begin, self._doubts = False, now, 0
        self._moves = 2 ** max(self._failures - 1, 0)
        return True

    def fits(self, plan: Plan, unit: float, estimator: Estimator, now: int) -> bool:
        """Take in that samples fit at a time in ns; return as `doubt`, since too few may fit."""
        # The unit of time is in s.
        self._doubts = 0
        if self.ended:
            return False
        if not self.acts:
            place = plan.place(self._begin) + 1
            begin = plan.levels[place].stamp if place < len(plan.levels) else now
            count, rejected = estimator.count_since(begin), estimator.screening.rejected
            if begin + round(_SHOWN * unit * NANOSECONDS) <= now and count >= _FEWEST:
                many = rejected - self._rejected > max(_REJECTED * count, 1)
                self._begin, self._rejected = now, rejected
                if many:
                    return self.doubt('many samples of a move do not fit', now)
                self._moves -= 1
                self.acts = self._moves == 0
        if self.acts or not self.beginnings:
            self.why = ''
        return False

    def confirm(self, model: Model, left: float) -> None:
        """Take in what a move planned with a model has left, as a share of its step."""
        if self.acts and left < _CONFIRMS:
            self.confirmed = model

    def end(self, why: str) -> None:
        """Take in that moves get worse by what is learnt: there is no feedback any more."""
        if not self.why:
            # Samples fit, and what they have confirmed is no better.
            self.confirmed = None
        self.why, self.ended, self.acts = why, True, False

    @property
    def parameters(self) -> str:
        """Say which parameters plans use where samples do not fit."""
        return 'the parameters given' if self.confirmed is None else (
            'the parameters that samples confirmed last')
