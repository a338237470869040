"""Commands to plant or driver, their receipts, and coils that were cut off."""

from collections.abc import Callable, Iterable, Mapping
import math

from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Planner
from hmsa_ros.runtime.deviations import Deviations
from hmsa_ros.runtime.receipts import Offset, Receipts
from hmsa_ros.runtime.records import Environment, Output, Send, Settings, Severity, Verdict
from hmsa_ros.runtime.takeover import Takeover

# Interval in ns at which a cut-off is acknowledged.
_AGAIN = 100_000_000
# Time in ns that a request waits for a device that sends receipts but receives nothing: after an
# outage, DDS connects the two directions one after the other.
_PATIENCE = 10_000_000_000
# Fraction of half a natural period, and of lead_time, from which a clock offset is reported.
_SHARE = 0.1


# Far enough ahead to send all levels.
_FAR = 2**62


class CommandLink:
    """
    Send commands, track the reports of devices, and adapt the plans to them.

    ``fresh`` contains the joints whose device appeared after the last level and has not received
    it. ``cut`` contains those whose device rejects commands from before a cut-off, ``open`` those
    with an open interlock, and ``locked`` those that only accept 0 T after that. ``apart``
    contains those whose clock differs so much that no command would apply in time. ``since`` is
    the time at which a plan began to wait for devices, in ns by the steady clock.
    """

    def __init__(
            self, planners: Mapping[str, Planner], receipts: Receipts, deviations: Deviations,
            takeover: Takeover, environment: Environment, outputs: list[Output]) -> None:
        self._planners, self._deviations, self._takeover = planners, deviations, takeover
        self.receipts, self._around = receipts, environment
        #: Delivers a command immediately, before any other work.
        self.deliver: Callable[[Send], None] = outputs.append
        #: Returns whether the plan is a stop, which is sent to devices that are silent, too.
        self.stops: Callable[[], bool] = lambda: False
        self.sent = self.heartbeats = 0
        self._absent: set[str] = set()
        self._reporters: dict[str, frozenset[bytes]] = {}
        self.fresh: set[str] = set()
        self.cut: set[str] = set()
        self.locked: set[str] = set()
        self.open: set[str] = set()
        self.apart: set[str] = set()
        self.since: int | None = None
        self._acknowledged: dict[str, int] = {}
        self._cut_at: dict[str, int] = {}  # time in ns that names the cut-off of a joint
        self._void: set[str] = set()  # joints whose plan is older than a cut-off

    # -- silence -------------------------------------------------------------------------------

    @property
    def all_silent(self) -> bool:
        """Whether all devices have fallen silent."""
        return bool(self.receipts.silent) and self.receipts.silent >= self._planners.keys()

    def look(self) -> None:
        """Doubt the position of joints whose device has fallen silent or is received again."""
        for name in self.receipts.look():
            self._takeover.doubt(name)

    # -- commands ------------------------------------------------------------------------------

    def send(self, now: int, *, everything: bool = False) -> None:
        """Send the levels that are due at a time in ns, or all planned levels."""
        # Commands may arrive although nothing comes back.
        silent, deviations = self.receipts.silent, self._deviations
        if silent and self.stops():
            silent = set()
        for name, planner in self._planners.items():
            if name in silent | self.apart | self.cut:
                # The command would arrive too late, apply at another time, or be rejected.
                continue
            if name in self._void and name in deviations.astray or deviations.lost(name):
                # The plan is for another state, and is being replaced.
                continue
            self._void.discard(name)
            for level in planner.due(_FAR if everything else now):
                self.fresh.discard(name)
                self._hand_out(name, level.stamp, level.flux_density, now, level=True)
                self.sent += 1

    def _hand_out(
            self, name: str, stamp: int, flux_density: float, now: int, *,
            level: bool = False) -> None:
        self.deliver(Send(name, stamp, flux_density))
        self.receipts.sent(name, stamp, now, level=level)
        self._deviations.sent(name, stamp, flux_density, now, level=level)

    def beat(self, now: int, *, finds_lost: bool) -> None:
        """
        Send the levels in force again, as a heartbeat of the planner.

        A level that was sent and took no effect in time is not among them: by now it would leave
        vibration, and the rest is planned anew instead. Until its device has acknowledged it, or
        reported its effect, it may be lost, and nothing is sent: if only the report is late, the
        level before it would leave vibration, too. ``finds_lost`` tells whether lost levels are
        looked for; otherwise they are repeated.
        """
        for name, planner in self._planners.items():
            if name in self.receipts.silent | self.cut | self.fresh | self.apart:
                # The last level is not meant for this device.
                continue
            if self._deviations.doubts(name):
                continue
            stamp, following = planner.beat_stamp(now), planner.next_stamp
            level = planner.last_sent.flux_density
            lost = self._deviations.lost(name)
            if (finds_lost and not lost and name in self._deviations.newest
                    and self.receipts.owed(name) and planner.awaiting_change):
                continue
            if lost:
                if stamp <= planner.last_sent.stamp:
                    # It would replace the last level, which is on its way.
                    continue
                level = self._deviations.newest.get(name, (0, level))[1]
            if lost or following is None or stamp < following:
                self._hand_out(name, stamp, level, now)
                self.heartbeats += 1

    def acknowledge(self, joint: str) -> None:
        """
        Acknowledge a cut-off if the coil is off; rate-limited.

        The command is 0 T from exactly the time of the cut-off on. The device rejects all others
        until then, so that no level takes effect that was planned without knowing of it.
        """
        steady, now, stamp = (
            self._around.steady(), self._around.clock(), self._cut_at.get(joint, 0))
        off = joint not in self.open if joint in self.locked else (
            self._deviations.newest.get(joint, (0, math.nan))[1] == 0.0)
        if joint in self.apart:
            # No heartbeat would follow, and it would be cut off again.
            return
        if off and stamp and steady - self._acknowledged.get(joint, -_AGAIN) >= _AGAIN:
            self._acknowledged[joint] = steady
            self._hand_out(joint, stamp, 0.0, now)

    # -- devices that are new, or cut off ------------------------------------------------------

    def look_for_newcomers(self) -> Verdict | None:
        """Find devices that are new since the last look; return the verdict on a plan."""
        verdict, absent = None, self._absent
        self._absent = {x for x in self._planners if not self._around.found(x)}
        for joint in sorted(self._planners.keys() - self._absent):
            before, now = self._reporters.get(joint, frozenset()), self._around.reporters(joint)
            self._reporters[joint] = now or before
            if before and now - before:
                # Another device took over, before its first receipt or without receipts.
                self._deviations.newest.pop(joint, None)
            elif before or joint not in absent:
                # A known device that is back after an outage is not new. Discovery of a first
                # device finds one topic after the other.
                continue
            found = self._appeared(joint)
            verdict = verdict or found
        return verdict

    def received(
            self, joint: str, time: int, command: int | None, *,
            late: bool = False) -> Verdict | None:
        """Process a receipt as `Receipts.received` does; return the verdict on a plan."""
        restarted = self.receipts.received(
            joint, time, command, self._around.clock(), late=late,
            comparable=not self._around.one_clock())
        if not restarted:
            return None
        self._deviations.newest.pop(joint, None)
        return self._appeared(joint)

    def _appeared(self, joint: str) -> Verdict | None:
        """Record a device that has not received the plan; return the verdict on the plan."""
        self.fresh.add(joint)
        planner = self._planners[joint]
        planned = bool(planner.plan.segments)
        planner.restart()
        dropped = self._dropped(
            joint, Code.MISSED, f'plant or driver of joint {joint} started after the commands '
            'were sent: the commands that it missed are dropped')
        return dropped if planned else None

    def cut_off(
            self, joint: str, settings: Settings, *, in_force: bool,
            locked: bool, time: int = 0) -> Verdict | None:
        """
        Record whether the coil of a joint is cut off; return the verdict on its plan.

        ``time`` names the cut-off, in ns of the device's clock; 0 while it is locked.
        """
        known = joint in (self.open if locked else self.cut)
        self.open.discard(joint)
        if not in_force:
            if joint in self.cut and self._planners[joint].last_sent.flux_density == 0.0:
                # The device has received the level to be repeated.
                self.fresh.discard(joint)
            self.cut.discard(joint)
            self.locked.discard(joint)
            self._acknowledged.pop(joint, None)
            self._cut_at.pop(joint, None)
            return None
        if time:
            self._cut_at[joint] = time
        if locked:
            self.open.add(joint)
            self.locked.add(joint)
        if known:
            return None
        self.cut.add(joint)
        self.receipts.void(joint)
        if not self._takeover.engaged or joint in self.apart:
            # Nothing is planned, or no longer.
            return None
        if settings.after_cut_off == 'resume' and not locked:
            self._takeover.doubt(joint)
            self._deviations.replan(joint)
            self._void.add(joint)
            return None
        planned = bool(self._planners[joint].plan.segments)
        self._planners[joint].abandon()
        dropped = self._dropped(
            joint, Code.INTERLOCK, f'{self.interlock(joint)}: the rest of the sequence is dropped',
        ) if locked else self._dropped(
            joint, Code.CUT_OFF, f'the coil of joint {joint} was cut off by the plant or driver: '
            'the rest of the sequence is dropped')
        # A request that waits is carried out once the cut-off is acknowledged.
        return dropped if planned or locked else None

    def interlock(self, joint: str) -> RefusedError:
        """Return the refusal of a request for a joint that is locked."""
        return RefusedError(
            Code.INTERLOCK, f'the interlock of the driver of joint {joint} is open, or its '
            'hardware is out of reach (see /diagnostics), so the coil is off: close the interlock '
            '(hmsa interlock close), then send a new request')

    def check(self, joints: Iterable[str]) -> None:
        """
        Check devices before joints move.

        Raises
        ------
        RefusedError
            If one is locked, or if its clock differs so much that no command applies in time.

        """
        for joint in joints:
            if joint in self.open:
                raise self.interlock(joint)
            if joint in self.apart:
                raise self.differs(joint)

    def differs(self, joint: str) -> RefusedError:
        """
        Return the refusal of a request for a joint of ``apart``.

        Raises
        ------
        ValueError
            If no receipt has shown the offset of its clock.

        """
        offset = self.receipts.clock(joint).offset
        if offset is None:
            raise ValueError(f'the clock offset of joint {joint} is unknown')
        when = 'come too late' if offset.ahead > 0 else (
            f'apply {-offset.ahead / NANOSECONDS:.3f} s after its time')
        return RefusedError(
            Code.CLOCKS_DIFFER, f'every command would {when}, since {offset.words}')

    def check_clock(self, joint: str, settings: Settings) -> Verdict | None:
        """
        Compare the clock of a joint's device after a receipt; return the verdict on its plan.

        Its plan is dropped if it is so far ahead that all commands come too late, or behind by
        more than the samples of a start may be; or if it was set in the middle of a move.
        """
        offset, step = self.receipts.clock(joint).offset, self.receipts.take_step(joint)
        if offset is None:
            self.apart.discard(joint)
            return None
        planner, before = self._planners[joint], joint in self.apart
        lead, now = planner.options.lead_time, self._around.clock()
        apart = offset.least > lead or -offset.most > max(lead, settings.takeover_max_age)
        spoilt = abs(step) - offset.error > lead and (planner.moves(now) or planner.pending)
        if before or apart or spoilt:
            # Times of its clock from before it was set.
            self._takeover.forget(joint)
            self._deviations.forget_times(joint)
        if not apart:
            self.apart.discard(joint)
        elif not before:
            self.apart.add(joint)
        if before or not (apart or spoilt):
            return None
        if min(step, offset.ahead) < 0:
            self._withdraw(joint, offset, now)
        self.fresh.add(joint)
        planner.abandon()
        return self._dropped(joint, Code.CLOCKS_DIFFER, (
            f'{offset.words}; the sequence is dropped, and nothing is sent until a new request'
            if apart else
            f'the clock of the plant or driver of joint {joint}, or of the planner, was set '
            f'{"ahead" if step > 0 else "back"} by {abs(step) / NANOSECONDS:.3f} s in the middle '
            'of a move: the rest of the sequence is dropped'))

    def _withdraw(self, joint: str, offset: Offset, now: int) -> None:
        """
        Withdraw the levels that a device would apply when its clock reaches their timestamps.

        The level in force, from now on by its clock, replaces all later ones.
        """
        level = self._deviations.newest.get(joint)
        if level is not None and self._takeover.engaged and joint not in self.cut | self.open:
            self._hand_out(joint, now + offset.ahead, level[1], now)

    def _dropped(self, joint: str, code: Code, words: str) -> Verdict:
        """Have the next request start from a sample; return the verdict on a dropped plan."""
        self._takeover.doubt(joint)
        self._deviations.astray.discard(joint)
        return Verdict(
            Severity.ERROR, code,
            f'{words}, and the next request starts from where the actuator is then')

    def must_wait(self, settings: Settings) -> bool:
        """
        Return whether planning must wait until a cut-off device obeys and commands arrive.

        Whether a device is cut off is known from its first receipt on. Cut-offs are acknowledged
        meanwhile: here, since without a request nothing may be sent.

        Raises
        ------
        RefusedError
            If commands have not arrived, or a cut-off has lasted, for a long time.

        """
        names = self._deviations.astray
        for joint in self.cut:
            self.acknowledge(joint)
        # After a loss, a heartbeat shows whether commands arrive again.
        lost = next((x for x in self._planners if self.receipts.lost(
            x, *((0,) if x in self.cut or self._deviations.lost(x) else ()))), '')
        # Asking the middleware takes far longer than looking up.
        owed = any(
            x not in self.receipts.joints and self._around.reports(x) for x in self._planners)
        if not (lost or self.cut or owed) and all(
                level[1] != 0.0 or self.receipts.since(name, level[0])
                for name, level in self._deviations.newest.items() if name in names):
            self.since = None
            return False
        if self.since is None:
            self.since = self._around.steady()
        passed = self._around.steady() - self.since
        if not (lost or self.cut):
            return passed <= settings.takeover_timeout
        if passed > _PATIENCE:
            self.since = None
            if not lost:
                raise RefusedError(
                    Code.CUT_OFF,
                    f'the coil of joint {min(self.cut)} was cut off, and the plant or driver has '
                    f'not acknowledged 0 T for {passed / NANOSECONDS:.0f} s: see its log, and '
                    'send the request again once the coil is off')
            how = (
                'and no receipts either: start the plant or driver, check the network, or restart '
                'it if its host has another address now'
                if lost in self.receipts.silent else
                'though its receipts arrive: check the network in the direction from the planner '
                'to the plant or driver, or restart it if its host has another address now')
            raise RefusedError(
                Code.UNHEARD,
                f'commands of joint {lost} have not arrived for {passed / NANOSECONDS:.0f} s, '
                f'{how}, and send the request again')
        return True

    @property
    def clocks(self) -> str:
        """A message if the clock offset shifts or spoils moves; else empty."""
        offset, limits = self.receipts.offset, []
        for planner in self._planners.values():
            model, plan = planner.model, planner.plan
            stretch = plan.segments[-1].stretch if plan.segments else plan.levels[-1].stretch
            limits += [math.pi / model.frequency(stretch) * model.units.time * NANOSECONDS,
                       planner.options.lead_time or math.inf]
        return '' if offset is None or (
            abs(offset.ahead) - offset.error <= _SHARE * min(limits)) else offset.words
