"""Sequences of setpoints: the paper's, and refusals and fallbacks with reasons."""

import contextlib
from itertools import pairwise
import math

from core_oracle import follow, holding_load, SEQUENCES, UPPER_LIMIT
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from hmsa.errors import BadInputError
from hmsa.model.delivery import Delivery
from hmsa.model.equations import critical_zeta, natural_frequency, stretch_limits
from hmsa.model.moves import Limits, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import Units
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import plan_two_step

PAPER = NondimensionalParameters()
SPAN = 10.0
# Deviation from rest at the target after arrival, in stretch.
AT_REST = 1e-8


def group(zeta, j_lim=5.0):
    return NondimensionalParameters(zeta=zeta, j_lim=j_lim)


def setpoints(*pairs):
    return [Setpoint(stretch, span) for stretch, span in pairs]


def distance(state, target, material):
    return max(
        abs(state[0] - target), abs(state[1]) / float(natural_frequency(target, material)))


def command(segments):
    """Return the whole command as (time, load)."""
    return [(x.begin + level.time, level.load) for x in segments for level in x.move.levels]


def state_at(time, segments, material, start=(1.0, 0.0)):
    """Return the state under the command by an independent integration."""
    levels = [x for x in command(segments) if x[0] < time]
    ends = [x[0] for x in levels[1:]] + [time]
    return follow(
        start, [(end - begin, load) for (begin, load), end in zip(levels, ends, strict=True)],
        material.zeta, material.j_lim, material.c1)


# -- the paper's sequences ----------------------------------------------------------------------


@pytest.mark.parametrize(('figure', 'zeta', 'j_lim', 'stretches'), SEQUENCES)
def test_each_setpoint_of_the_paper_is_reached_and_held(figure, zeta, j_lim, stretches):
    material = group(zeta, j_lim)
    segments = plan_sequence([Setpoint(x, SPAN) for x in stretches], material)
    assert [x.move.code for x in segments] == [Code.TWO_STEP] * 3
    assert [x.begin for x in segments] == [0.0, 10.0, 20.0]
    # Six steps in place of three, at rest between the intermediate time and the end.
    assert len(command(segments)) == 6
    state = (1.0, 0.0)
    for segment in segments:
        first, last = segment.move.levels
        assert first.time == 0.0
        assert 0.0 < last.time == segment.move.duration < SPAN
        assert last.load == pytest.approx(
            holding_load(segment.setpoint.stretch, j_lim), rel=1e-11)
        state = follow(state, [(last.time, first.load)], zeta, j_lim, 2.0)
        assert distance(state, segment.setpoint.stretch, material) < AT_REST
        # Long enough to see it ring, short enough for the stiffness near the limit.
        hold = min(SPAN - last.time,
                   12.0 / float(natural_frequency(segment.setpoint.stretch, material)))
        state = follow(state, [(hold, last.load)], zeta, j_lim, 2.0)
        assert distance(state, segment.setpoint.stretch, material) < AT_REST
        assert segment.end.stretch == pytest.approx(state[0], abs=AT_REST)


def test_moves_between_rests_are_the_single_plans():
    segments = plan_sequence(setpoints((1.1, 10), (1.2, 10), (1.4, math.inf)), PAPER)
    for (start, target), segment in zip(
            pairwise((1.0, 1.1, 1.2, 1.4)), segments, strict=True):
        plan = plan_two_step(start, target, PAPER)
        assert segment.move.levels[0].load == pytest.approx(plan.beta_p, rel=1e-9)
        assert segment.move.duration == pytest.approx(plan.tau_p, rel=1e-9)
        assert segment.move.reason == ''
    assert segments[-1].setpoint.span == math.inf
    assert segments[-1].end.stretch == pytest.approx(1.4, abs=1e-11)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0.5, 2.2), st.floats(0.3, 6.0)), min_size=1, max_size=5),
       st.sampled_from([0.0, 0.02, 0.2, 1.1, 2.3]))
def test_whatever_the_spans_the_last_setpoint_is_reached(points, zeta):
    material = group(zeta)
    planned = setpoints(*points, (1.3, math.inf))
    segments = plan_sequence(planned, material, short_spell='continue')
    last = segments[-1]
    state = state_at(last.begin, segments, material)
    assert state == pytest.approx((last.start.stretch, last.start.rate), abs=1e-7)
    if math.isfinite(last.move.duration):
        state = state_at(last.begin + last.move.duration, segments, material)
        assert distance(state, 1.3, material) < 1e-7
    else:
        assert last.move.code in (Code.TOO_DAMPED, Code.INDISTINGUISHABLE)
    for segment, following in pairwise(segments):
        assert following.begin == pytest.approx(
            segment.begin + segment.setpoint.span, rel=1e-15)
        assert following.start == segment.end
        assert all(x.time <= segment.setpoint.span * (1 + 1e-12) for x in segment.move.levels)


# -- spells too short ---------------------------------------------------------------------------


def test_a_spell_too_short_is_refused_with_both_times():
    with pytest.raises(RefusedError, match=(
            r'the move from stretch 1.1 to 1.2 takes 1.353, its setpoint lasts 1: '
            'expected a duration at least as long as the move')) as caught:
        plan_sequence(setpoints((1.1, 10), (1.2, 1.0)), PAPER)
    assert caught.value.code is Code.SPELL_TOO_SHORT


def test_a_spell_as_long_as_the_move_is_long_enough():
    tau_p = plan_two_step(1.0, 1.2, PAPER).tau_p
    segments = plan_sequence(setpoints((1.2, tau_p), (1.1, 10)), PAPER)
    assert [x.move.code for x in segments] == [Code.TWO_STEP] * 2
    plan_sequence(setpoints((1.2, math.nextafter(tau_p, 0.0)), (1.1, 10)), PAPER)
    with pytest.raises(RefusedError):
        plan_sequence(setpoints((1.2, tau_p * (1 - 1e-9)), (1.1, 10)), PAPER)


def test_continue_plans_on_from_where_the_actuator_really_is():
    segments = plan_sequence(
        setpoints((1.2, 0.7), (1.1, 10)), PAPER, short_spell='continue')
    first, last = segments
    assert first.move.code is Code.SPELL_TOO_SHORT
    assert first.move.duration == math.inf
    assert len(first.move.levels) == 1
    assert 'the duration 0.7 ends before stretch 1.2 is reached' in first.move.reason
    expected = follow((1.0, 0.0), [(0.7, first.move.levels[0].load)], 0.2, 5.0, 2.0)
    assert (last.start.stretch, last.start.rate) == pytest.approx(expected, abs=1e-11)
    assert last.start.rate > 0.1
    state = state_at(0.7 + last.move.duration, segments, PAPER)
    assert distance(state, 1.1, PAPER) < AT_REST


def test_continue_finishes_the_last_move_after_its_span():
    segments = plan_sequence(setpoints((1.2, 0.7)), PAPER, short_spell='continue')
    move = segments[0].move
    assert move.code is Code.SPELL_TOO_SHORT
    assert len(move.levels) == 2
    state = state_at(move.duration, segments, PAPER)
    assert distance(state, 1.2, PAPER) < AT_REST


# -- refusals, each with its own reason ---------------------------------------------------------


LIMITED = MoveRequest.of(PAPER, limits=Limits(-0.5, 0.5))
REFUSALS = [
    (Code.BAD_INPUT, 'no setpoint given', [], PAPER),
    (Code.OUT_OF_RANGE, 'target stretch is 2.7: .*0.2520 and 2.6940 of J_lim 5', [(2.7, 10)],
     PAPER),
    (Code.OUT_OF_RANGE, 'target stretch is 0.25: .*0.2520 and 2.6940 of J_lim 5', [(0.25, 10)],
     PAPER),
    (Code.OUT_OF_RANGE, 'target stretch is 1.7: .*0.5392 and 1.6751 of J_lim 1',
     [(1.2, 10), (1.7, 10)], group(0.2, 1.0)),
    (Code.FLUX_LIMIT, 'stretch 1.4 needs a flux density of 0.9648: expected -0.5 to 0.5',
     [(1.4, 10)], LIMITED),
    (Code.FLUX_LIMIT, 'stretch 0.8 needs a flux density of -0.7845: expected -0.5 to 0.5',
     [(0.8, 10)], LIMITED),
    # Of the intermediate level.
    (Code.FLUX_LIMIT, r'stretch 1.35 needs a flux density of 0.9\d*: expected -1 to 0.9',
     [(1.35, 10)], MoveRequest.of(PAPER, State(1.45), limits=Limits(-1.0, 0.9))),
    (Code.SPELL_TOO_SHORT, 'its setpoint lasts 0.5', [(1.1, 0.5)], PAPER)]


@pytest.mark.parametrize(('code', 'reason', 'points', 'frame'), REFUSALS)
def test_refusals_carry_their_code_and_their_reason(code, reason, points, frame):
    with pytest.raises(RefusedError, match=reason) as caught:
        plan_sequence(setpoints(*points), frame)
    assert caught.value.code is code
    assert isinstance(caught.value, BadInputError)
    assert '\n' not in str(caught.value)


def test_reasons_are_worded_in_the_units_given():
    units = Units(4.36e-3, 0.1257, ' s', ' T')
    with pytest.raises(RefusedError, match=r'of 0.1213 T: expected -0.1257 T to 0.06285 T'):
        plan_sequence(
            setpoints((1.4, 10)), MoveRequest.of(PAPER, limits=Limits(-1.0, 0.5), units=units))
    with pytest.raises(RefusedError, match=r'takes 0.005737 s, its setpoint lasts 0.00218 s'):
        plan_sequence(setpoints((1.1, 0.5)), MoveRequest.of(PAPER, units=units))


@pytest.mark.parametrize(('arguments', 'reason'), [
    ({'shaper': 'tow_step'}, "shaper is 'tow_step': expected one of two_step"),
    ({'short_spell': 'ignore'}, "short_spell is 'ignore': expected one of refuse, continue"),
    ({'frame': MoveRequest.of(PAPER, State(2.7))},
     'start stretch is 2.7: expected a stretch between'),
    ({'frame': MoveRequest.of(PAPER, State(0.0))},
     'start stretch is 0: expected a stretch between')])
def test_arguments_out_of_range_are_bad_input(arguments, reason):
    with pytest.raises(BadInputError, match=reason):
        plan_sequence(setpoints((1.1, 10)), **{'frame': PAPER, **arguments})


@pytest.mark.parametrize(('stretch', 'span', 'reason'), [
    (math.nan, 10.0, 'stretch is'), (math.inf, 10.0, 'stretch is inf'),
    (1.1, 0.0, 'duration is 0'), (1.1, -1.0, 'duration is -1'),
    (1.1, math.nan, 'duration is nan')])
def test_setpoints_out_of_range_are_refused(stretch, span, reason):
    with pytest.raises(BadInputError, match=reason):
        Setpoint(stretch, span)


@pytest.mark.parametrize('limits', [(1.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (0.0, math.nan)])
def test_limits_out_of_order_are_refused(limits):
    with pytest.raises(BadInputError, match='is not below the maximum'):
        Limits(*limits)


# -- what replaces a two-step command -----------------------------------------------------------


def test_too_damped_says_so_and_steps():
    segments = plan_sequence(setpoints((1.1, 30), (1.2, 10)), group(4.0))
    move = segments[0].move
    assert (move.code, move.duration, len(move.levels)) == (Code.TOO_DAMPED, math.inf, 1)
    assert 'zeta 4 is too damped for the response to cross stretch 1.1' in move.reason
    # The next one starts where the creeping has got to.
    state = follow((1.0, 0.0), [(30.0, holding_load(1.1, 5.0))], 4.0, 5.0, 2.0)
    assert segments[1].start.stretch == pytest.approx(state[0], abs=1e-11)


def test_close_to_critical_says_so_and_steps():
    zeta = 0.99999 * float(critical_zeta(1.1, PAPER))
    move = plan_sequence(setpoints((1.1, 30)), group(zeta))[0].move
    assert (move.code, move.duration, len(move.levels)) == (
        Code.INDISTINGUISHABLE, math.inf, 1)
    assert 'so close to critical damping' in move.reason


def test_where_it_is_already_it_holds():
    move = plan_sequence(setpoints((1.0, 10)), PAPER)[0].move
    assert (move.code, move.duration, move.reason) == (Code.HOLD, 0.0, '')
    assert [x.time for x in move.levels] == [0.0]
    assert abs(move.levels[0].load) < 1e-15


def test_the_step_is_the_papers_unshaped_input():
    segments = plan_sequence(setpoints((1.1, 10), (1.2, 10)), PAPER, shaper='step')
    assert [x.move.code for x in segments] == [Code.STEP] * 2
    assert [x.move.levels[0].load for x in segments] == pytest.approx(
        [holding_load(1.1, 5.0), holding_load(1.2, 5.0)], rel=1e-12)
    state = follow((1.0, 0.0), [(10.0, holding_load(1.1, 5.0))], 0.2, 5.0, 2.0)
    assert (segments[1].start.stretch, segments[1].start.rate) == pytest.approx(
        state, abs=1e-11)


# -- times --------------------------------------------------------------------------------------


@pytest.mark.parametrize('resolution', [1e-6, 1e-3, 0.01])
def test_rounded_commands_are_followed_as_they_are(resolution):
    segments = plan_sequence(
        setpoints((1.1, 5), (1.2, 5), (1.4, 5)),
        MoveRequest.of(PAPER, delivery=Delivery(resolution=resolution)))
    for segment in segments:
        for level in segment.move.levels:
            count = level.time / resolution
            assert count == pytest.approx(round(count), abs=1e-6)
    # Each move starts from what the rounding of the last has left, and takes it away.
    state = state_at(segments[-1].begin, segments, PAPER)
    assert (segments[-1].start.stretch, segments[-1].start.rate) == pytest.approx(
        state, abs=1e-10)
    left = max(abs(state[0] - 1.2), abs(state[1]))
    assert left < resolution


@pytest.mark.parametrize('zeta', [0.0, 1e-6, 0.02, 0.2, 20.0])
def test_spans_of_days_are_planned(zeta):
    segments = plan_sequence(setpoints((1.3, 1e8), (0.8, 1e9), (1.1, 10)), group(zeta))
    assert [x.begin for x in segments] == [0.0, 1e8, 1e8 + 1e9]
    assert segments[0].end.stretch == pytest.approx(1.3, abs=1e-9)
    assert segments[2].start.stretch == pytest.approx(0.8, abs=1e-9)
    assert abs(segments[2].start.rate) < 1e-8


def test_days_of_ringing_without_damping_are_planned_on():
    segments = plan_sequence(
        setpoints((1.3, 1e8), (1.1, 10)), group(0.0), shaper='step')
    lower, upper = stretch_limits(5.0)
    assert lower < segments[1].start.stretch < upper


def test_days_next_to_the_limit_are_planned():
    near = 0.9999 * UPPER_LIMIT[5.0]
    for zeta in (0.02, 0.2):
        segments = plan_sequence(setpoints((near, 1e8), (1.1, 10)), group(zeta))
        assert segments[1].start.stretch == pytest.approx(near, abs=1e-9)


@pytest.mark.parametrize('rate', [0.0, 1e-9, -40.0, 100.0])
@pytest.mark.parametrize('limits', [
    Limits(-10.0, 10.0), *(pytest.param(x, marks=pytest.mark.slow) for x in (
        Limits(), Limits(-1e-3, 1e-3)))])
def test_corners_of_every_argument_end_in_a_plan_or_a_refusal(rate, limits):
    lower, upper = stretch_limits(5.0)
    for start in (lower + 1e-6, 1.0, upper - 1e-6):
        for target in (lower + 1e-6, 1.0, 1.0 + 1e-9, upper - 1e-6):
            for span in (1e-12, 1e6):
                with contextlib.suppress(RefusedError):
                    segments = plan_sequence(
                        setpoints((target, span), (1.2, 10.0)),
                        MoveRequest.of(PAPER, State(start, rate), limits=limits),
                        short_spell='continue')
                    assert all(
                        limits.minimum <= load <= limits.maximum
                        for _, load in command(segments))
