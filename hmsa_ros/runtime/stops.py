"""Whether a stop was carried out, by what plant or driver and the samples show."""

from collections.abc import Callable, Mapping

from hmsa.judge.records import Tolerances
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import ALWAYS
from hmsa_ros.runtime.arrival_monitor import ArrivalMonitor
from hmsa_ros.runtime.command_link import CommandLink
from hmsa_ros.runtime.records import Environment, Severity, Verdict

# Time in ns by the steady clock, after the planned rest, until a stop counts as not acknowledged:
# receipts arrive five times a second, and a busy machine delays them.
_PATIENCE = 2 * NANOSECONDS
# Largest difference of an applied level from the commanded one, as a fraction of the largest
# recent level. Hardware rounds by less.
_SAME = 5e-4
# Time in ns by which hardware may apply a level early: it rounds times to its own clock (a serial
# board by up to 1 us). Shorter than the time between any two levels.
_EARLY = 500_000
# Findings that show rest, also beside the predicted stretch or after its time.
_RESTING = (Code.ARRIVED, Code.OFF_TARGET, Code.LATE)
# Findings that contradict rest.
_MOVING = (Code.VIBRATING, Code.MISSED)
_SWITCH_OFF = 'switch the coil off there'


class Stops:
    """
    Decide whether the newest stop was carried out.

    A joint has stopped once its plan is at rest and its device has acknowledged the level in force
    then: by a receipt from a time at which the level applies, or, without receipts, by reporting
    that level, or by samples that rest. Samples that vibrate contradict that.
    """

    def __init__(
            self, group: PlannerGroup, devices: CommandLink,
            newest: Mapping[str, tuple[int, float]],
            watch: ArrivalMonitor, environment: Environment,
            tolerances: Callable[[], Tolerances]) -> None:
        """
        Begin without a stop.

        ``newest`` contains timestamp in ns and level in T of the newest change of each joint. A
        vibration within the tolerances is rest.
        """
        self._group, self._devices, self._newest = group, devices, newest
        self._watch, self._around, self._tolerances = watch, environment, tolerances
        self._plan: int | None = None  # number of the plan of the stop; None without one
        self._over = False  # whether it was acknowledged
        self._name = ''
        self._begun = 0  # time in ns by the steady clock
        self._rests: int | None = None  # the same, of the planned rest, once it has passed
        self._acknowledged: set[str] = set()
        self._warned = False

    def begin(self, name: str) -> None:
        """Follow a stop of a name, whose plan has just been adopted."""
        self._plan, self._name, self._over = self._group.number, name, False
        self._begun, self._rests, self._warned = self._around.steady(), None, False
        self._acknowledged.clear()

    def drop(self) -> None:
        """Follow no stop any more."""
        self._plan = None

    @property
    def open(self) -> bool:
        """Whether a stop that was not replaced is still to be acknowledged."""
        return self.judges and not self._over

    @property
    def judges(self) -> bool:
        """Whether the newest plan is that of a stop."""
        return self._plan == self._group.number

    def look(self, now: int) -> Verdict | None:
        """Return a new verdict on the stop at a time in ns, if there is one."""
        if not self.open:
            return None
        steady = self._around.steady()
        if self._rests is None:
            if now < max(x.plan.segments[-1].rests if x.plan.segments else ALWAYS
                         for x in self._group.planners.values()):
                return None
            self._rests = steady
        self._acknowledged |= {
            x for x in self._group.planners
            if x not in self._acknowledged and self._acknowledges(x, now)}
        late = steady - self._rests > _PATIENCE
        if self._acknowledged >= self._group.planners.keys():
            if self._watch.open and self._watch.measuring and not late:
                return None
            self._over = True
            return self._carried_out()
        if not late or self._warned:
            return None
        self._warned = True
        return Verdict(Severity.ERROR, Code.UNHEARD, self._missing(now, steady), self._name)

    def _acknowledges(self, joint: str, now: int) -> bool:
        """Return whether the device of a joint has acknowledged the level at a time in ns."""
        if joint in self._devices.cut | self._devices.open:
            # The coil is off, and no level is accepted.
            return True
        plan = self._group.planners[joint].plan
        level = plan.level(now)
        if not plan.segments or level.due < plan.segments[-1].since - _EARLY:
            # Levels of the stop that took no effect were removed from the plan.
            return False
        received = self._devices.receipts.carried_out(joint, level.due)
        if received is False or self._devices.receipts.lost(joint):
            return False
        applied = self._differs(joint, now)
        if received:
            return not applied
        if self._around.unheard():
            return False
        return applied is False or self._shows_rest(joint) is True

    def _differs(self, joint: str, now: int) -> bool | None:
        """Return whether the newest applied level is another than planned; None if unknown."""
        if joint not in self._newest:
            return None
        plan = self._group.planners[joint].plan
        wanted, (_, found) = plan.level(now).flux_density, self._newest[joint]
        largest = max(abs(found), *(abs(x.flux_density) for x in plan.levels))
        return abs(found - wanted) > _SAME * largest

    def _shows_rest(self, joint: str) -> bool | None:
        """Return whether samples show that a joint rests, or that it moves; None for neither."""
        found = self._watch.findings.get(joint)
        if found is None or found.verdict not in (*_RESTING, *_MOVING):
            return None
        # It may rest beside the predicted stretch, and vibrate about that.
        return found.verdict in _RESTING and not (
            found.vibration > self._tolerances().of(found.setpoint)[1])

    def _carried_out(self) -> Verdict:
        shown = {x: self._shows_rest(x) for x in self._group.planners}
        for joint, rests in shown.items():
            if rests is False:
                return Verdict(
                    Severity.WARN, Code.VIBRATING, 'the stop was acknowledged, but '
                    f'{self._watch.findings[joint].message}', self._name)
        measured = all(shown.values())
        if off := sorted(self._devices.cut | self._devices.open):
            # Released, an actuator swings: that its coil is off says nothing of rest.
            how = f'the coil of {", ".join(off)} is off; ' + (
                'at rest, measured' if measured else 'no samples show whether it rests')
        else:
            how = 'at rest, ' + ('measured' if measured else 'acknowledged by plant or driver')
        return Verdict(Severity.OK, Code.STOPPED, f'stopped: {how}', self._name)

    def _missing(self, now: int, steady: int) -> str:
        """Return what is known of joints that have not acknowledged, in a sentence."""
        joint = min(self._group.planners.keys() - self._acknowledged)
        level = self._group.planners[joint].plan.level(now)
        receipts, passed = self._devices.receipts, (steady - self._begun) / NANOSECONDS
        received = receipts.carried_out(joint, level.due)
        if received is None:
            if unheard := self._around.unheard():
                return f'stop sent, but {unheard}; {_SWITCH_OFF}, if there is one'
            if self._differs(joint, now) is None:
                return (
                    f'stop sent, but the plant or driver of joint {joint} sends no receipts '
                    '(flux_density_received), no applied levels and no samples that show rest: '
                    f'the actuator may still move; check it, or {_SWITCH_OFF}')
        if received is not False and self._differs(joint, now):
            return (
                f'stop sent, but {passed:.1f} s later the newest applied level of joint {joint} '
                f'is {self._newest[joint][1]:.4g} T, where {level.flux_density:.4g} T was '
                f'commanded: {_SWITCH_OFF}')
        if joint in self._devices.apart:
            return f'stop not carried out: {self._devices.differs(joint)}; {_SWITCH_OFF}'
        return (
            f'stop sent, but the plant or driver of joint {joint} has not acknowledged it for '
            f'{passed:.1f} s: {_SWITCH_OFF}')
