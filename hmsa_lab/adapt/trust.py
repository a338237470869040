"""When an estimate is used, and which parameters plans use otherwise."""

from hmsa.model.units import NANOSECONDS
from hmsa.planning.timeline import JointModel, Timeline
from hmsa_lab.adapt.estimator import Estimator

# Number of successive updates with samples that do not fit until the estimator restarts.
_PERSISTENT = 3
# Time scales of motion, and samples of it, that must fit before an estimate is used.
_SHOWN, _FEWEST = 6.0, 10
# The same of a move slowed down to be corrected: a natural period. The first half of one of a
# block on finite elements looked like G 46 % too high, and the move then left 117 % of its step.
_EARLY = 2.5
# Largest error, as a fraction of the step, that confirms the parameters of a move.
_CONFIRMS = 0.02


class Trust:
    """
    Track how well the samples of one joint fit.

    An estimate is used once a whole move has fitted, or a natural period of one that waits to be
    corrected. While samples do not fit, plans use the parameters that a move confirmed last, or
    the given ones. If the misfit persists, the estimator restarts.

    After an estimate that was in use, what samples of one move show is not taken for the actuator:
    `failed` then asks for an estimate with a sensor that may have changed.
    """

    def __init__(self, begin: int) -> None:
        # Model of the last move that arrived, as measured.
        self.confirmed: JointModel | None = None
        self.beginnings = 0  # number of restarts
        self.acts = False
        self.why = ''  # why samples are not trusted; empty if they are
        # Whether the actuator has vibrated since samples do not fit: it or its coil may have
        # changed, and not its sensor.
        self.rang = False
        self.ended = False  # whether learnt parameters made moves worse
        # Time in ns from which a move has to fit, or from which the estimate has been used.
        self.begin = begin
        self._doubts = 0
        self._failed = False  # whether an estimate that fitted has failed later

    def doubt(
            self, why: str, now: int, *, used: bool = True, fitted: bool = False,
            at_once: bool = False) -> bool:
        """
        Record that samples do not fit at a time in ns; return whether to restart.

        An estimate that earlier samples ``fitted`` has failed, or one that plans ``used``.
        """
        self._doubts += 1
        persists = at_once or self._doubts >= _PERSISTENT
        if persists or not self.ended:
            self.why = why
        # The first samples of a motion, which are few, may not fit yet.
        if (self.acts or self.ended or not self.beginnings) and not persists:
            return False
        self._failed |= fitted or self.acts and used
        self.beginnings += 1
        # What has ended feedback may have changed, too.
        self.acts, self.ended, self.begin, self._doubts = False, False, now, 0
        return True

    def fits(
            self, plan: Timeline, unit: float, estimator: Estimator, now: int, *,
            waits: bool) -> None:
        """
        Record that samples fit at a time in ns.

        The move under way ``waits`` to be corrected, or does not.
        """
        self._doubts = 0
        if self.ended:
            return
        if not self.acts:
            begin = _next_move(plan, self.begin, now)
            span = round((_EARLY if waits else _SHOWN) * unit * NANOSECONDS)
            self.acts = begin + span <= now and estimator.count_since(begin) >= _FEWEST
            self.begin = now if self.acts else self.begin
        if self.acts or not self.beginnings:
            self.why = ''

    @property
    def doubts(self) -> bool:
        """Whether samples no longer fit an estimate in use, which further ones may confirm."""
        return self.acts and self._doubts > 0

    @property
    def failed(self) -> bool:
        """Whether an estimate in use has failed to fit later samples, after one was confirmed."""
        return self._failed and self.confirmed is not None

    def wait(self, now: int) -> None:
        """Use the estimate after another move that fits."""
        self.acts, self.begin = False, now

    def recover(self, *, given: bool) -> None:
        """Forget failures: the sensor is as it was; with the ``given`` parameters if so."""
        self._failed = False
        if given:
            self.confirmed = None

    def confirm(self, model: JointModel, left: float) -> None:
        """Record the error of a move planned with a model, as a fraction of its step."""
        if self.acts and left < _CONFIRMS:
            self.confirmed = model

    def end(self, why: str) -> None:
        """End feedback, since learnt parameters make moves worse."""
        if not self.why:
            # The samples fit, so the parameters that they confirmed are no better.
            self.confirmed = None
        self.why, self.ended, self.acts = why, True, False

    @property
    def kept(self) -> JointModel | None:
        """The parameters that plans use while samples do not fit; None for the given ones."""
        return None if self.rang else self.confirmed

    @property
    def parameters(self) -> str:
        """The parameters that plans use while samples do not fit, in words."""
        return 'the parameters given' if self.kept is None else (
            'the parameters that samples confirmed last')


def _next_move(plan: Timeline, since: int, now: int) -> int:
    """Return the beginning of the first move after a time, or `now`, in ns; on a path, a level."""
    place = plan.under_way(since)
    if place >= 0 and plan.segments[place].path is not None:
        place = plan.place(since) + 1
        return plan.levels[place].stamp if place < len(plan.levels) else now
    return next((x.begin for x in plan.segments if x.begin > since), now)
