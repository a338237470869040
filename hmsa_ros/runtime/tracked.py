"""One joint that feedback looks at: its estimator, and what the estimate says of the plan."""

from dataclasses import dataclass
import math

from hmsa_ros.core.timeline import Plan
from hmsa_ros.estimation import Estimate, Estimator
from hmsa_ros.estimation.motion import held
from hmsa_ros.estimation.words import sentence


@dataclass(eq=False)
class Joint:
    """What is known of one joint; times in ns."""

    estimator: Estimator
    start: float  # stretch before the setpoint under way
    latest: Estimate | None = None
    newest: int = 0  # time of the newest sample
    next_update: int = 0  # when to look at samples
    next_tell: int = 0  # when to tell the estimate
    amplitude: float = 0.0  # largest of the vibration since the last arrival
    setpoint: tuple[int, int] = (0, -1)  # number of the plan, and place of the setpoint under way
    fresh: bool = False  # whether there are samples that have not been looked at
    news: bool = False  # whether the latest estimate has not been held against the plan yet

    def note_start(self, plan: Plan, now: int) -> None:
        """Remember where the joint was before the setpoint under way at a time in ns."""
        place = plan.under_way(now)
        if (plan.number, place) == self.setpoint:
            return
        again = plan.number == self.setpoint[0] and place > self.setpoint[1] >= 0
        self.setpoint = plan.number, place
        if again:
            self.start = plan.segments[place - 1].stretch
        else:
            self.start = plan.levels[0].stretch if self.latest is None else self.latest.stretch

    def look_at_vibration(self, plan: Plan, found: Estimate) -> None:
        """Keep the largest amplitude since the last arrival."""
        place = plan.under_way(found.time)
        segment = plan.segments[place] if place >= 0 else None
        if segment is None or segment.arrival is None or found.time < segment.arrival:
            self.amplitude = 0.0
            return
        at = held(found.values, found.stretch, plan.level(found.time).flux_density)
        if at is not None:
            self.amplitude = max(self.amplitude, math.hypot(
                found.stretch - at[0], found.rate / at[1]))

    def words(self, plan: Plan, now: int, *, adapting: bool) -> str:
        """Say in a sentence without its stop what is wrong at a time in ns."""
        if self.latest is None:
            return 'no estimate yet'
        place = plan.under_way(now)
        target = plan.segments[place].stretch if place >= 0 else self.start
        return sentence(
            self.latest, self.estimator.prior.values, plan.level(now).flux_density, target,
            self.start, self.amplitude, adapting=adapting)

    def figures(self, found: Estimate) -> dict[str, object]:
        """Return parameters in SI, with deviations and given values, and counters."""
        prior, screening = self.estimator.prior.values, self.estimator.screening
        values: dict[str, object] = {'trusted': found.trusted}
        for key in found.free:
            values |= {
                key: f'{found.values[key]:.9g}', f'{key}.std': f'{found.deviations[key]:.3g}',
                f'{key}.nominal': f'{prior[key]:.9g}'}
        return values | {
            'learning': self.estimator.learning,
            'stretch': f'{found.stretch:.9g}', 'stretch_rate': f'{found.rate:.6g}',
            'noise': f'{found.noise:.3g}',
            'rejected': screening.rejected, 'frozen': screening.frozen,
            'unreadable': screening.unreadable, 'repeated': screening.repeated,
            'too_late': screening.late}
