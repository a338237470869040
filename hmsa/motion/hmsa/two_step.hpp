// The two-step command (Eq. 13): the load whose first turning point is the target, and its time.
#pragma once
#include "swing.hpp"

namespace hmsa {
enum Status { two_step, hold, too_damped, indistinguishable, no_two_step, not_converged, out_of_range, bad_input };
struct Plan {
    int status;
    double beta_p, tau_p, beta_1;
    int passes;
};
inline Plan without(int status, double beta_1 = __builtin_nan(""), int passes = 0)
{
    return {status, __builtin_nan(""), __builtin_nan(""), beta_1, passes};
}

struct Move {
    double start, rate, target;
};
struct Wanted {
    double least, most;  // admissible loads
    double rtol;
    double hold;  // deviation below which the actuator counts as already there
    bool rough = false;  // a guess for another search
};

// Below this fraction of the move or of the distance to a limit, the linearised motion determines
// the sign of the deviation.
constexpr double linear = 1e-6;
constexpr int most_passes = 80, newton_passes = 8, most_stuck = 4, most_crossing = 200000;
constexpr double coarse = 3e-7, farthest = 1e3;

// Difference between the cubic through two points with given slopes, and its tangent at the first
// one, at a fraction of the way to the second.
inline double beyond_line(double share, double rise, double way, double slope, double other)
{
    const double bend = way * (slope + other) - 2 * rise;
    return share * share * (rise - way * slope - bend + share * bend);
}

// Newton's method on d = direction (beta_1 - beta_p) > 0, kept inside a bracket: at d = 0 the
// motion overshoots the target, at a large d it stops short. The difference is the unknown because
// near critical damping it is smaller than the rounding of beta_p. The turning point is compared
// to the target by ln((l - lower)/(upper - l)), which is nearly linear in the load even close to a
// limiting stretch. The first integrations are coarse and only give a guess for the last ones,
// which start a new bracket. The search ends at the admissible loads or, if they are infinite, far
// from the holding load. With branches, d is relative to the load that would hold the target in
// their present states, under which the motion also overshoots.
template <class System, int NB = 0> struct Search {
    System system;
    Branches<NB> branches;
    double followed[NB + 1];
    double start, rate, target, direction, zeta, lower, upper, beta_1, held, move, frequency_at_start;
    double fine, enough, tolerance, least, most, top, guess, low, high, d;
    int pass, times_stuck;
    bool rough;
    // Of the previous turning point: d, its excess, and the slope of d by it; its time, and the
    // slope of it by the load; the relative change of d since then, and the accuracy of the
    // integration.
    struct { double d, excess, slope, time, time_by_load, went, exact; } before;
    Plan plan;

    double load() const { return held - direction * d; }
    // The load that balances a force at fixed branch states, with the given ratios.
    double balance(double force, const double *felt) const
    {
        double load = force;
        for (int b = 0; b < branches.count(); b++)
            load += felt[b] * (force - followed[b]);
        return load;
    }
    // Without damping the energy balance gives d. For a linear oscillator, damping reduces it by
    // 2 K/(1 + K) with the decay K over half a period. The damping ratio is the damping force over
    // that of the spring, at the rate half way by the energy balance. For fast motion branches are
    // springs, for slow motion dampers.
    HMSA_APART double first_guess() const
    {
        if (target == start)
            return infinity();
        const double half = 0.5 * (start + target);
        double felt[NB + 1], drag = system.drag * system.shape(half);
        for (int b = 0; b < branches.count(); b++) {
            const double omega = frequency(system, target);
            const double phase = omega / max(branches.pace(b, beta_1 - followed[b]), 1e-9 * omega);
            const double part = branches.ratio[b] * phase / (1 + phase * phase);
            felt[b] = part * phase;
            drag += part * system.elastic(target).d[0] / omega;
        }
        const auto energy = [&](double l) {
            double sum = system.energy(l);
            for (int b = 0; b < branches.count(); b++)
                sum += felt[b] * (system.energy(l) - followed[b] * l);
            return sum;
        };
        const double e0 = energy(start) + 0.5 * system.mass(start) * rate * rate;
        const double beta = (energy(target) - e0) / (target - start);
        const double end = balance(beta_1, felt), delta = direction * (end - beta);
        const double kinetic = e0 + beta * (half - start) - energy(half);
        const double fastest = sqrt(max(2 * kinetic / system.mass(half), 0.0));
        const double xi = 0.5 * drag * fastest / abs(delta);
        const double decay = xi < 0.9 ? exp(-3.141592653589793 * xi / sqrt(1 - xi * xi)) : 1e-3;
        return direction * (held - end) + delta * 2 * decay / (1 + decay);
    }
    // Returns whether a search is needed.
    HMSA_APART bool begin(const System &of, const double *m, const Move &from, double where, const Wanted &wanted)
    {
        system = of;
        start = from.start, rate = from.rate, target = from.target, direction = where;
        zeta = m[zeta_at], lower = m[lower_at], upper = m[upper_at];
        const auto elastic = system.elastic(target);
        beta_1 = elastic.v;
        held = balance(beta_1, branches.ratio);
        frequency_at_start = sqrt(branches.total) * frequency(system, start);
        move = abs(target - start) + abs(rate) / frequency(system, target);
        const double size = 1 + target;  // errors are relative to the move and the remaining room
        fine = max(min(wanted.rtol, 1e-10 * move / size), 1e-14);
        enough = max(0.1 * sqrt(fine), 1e-14 * size / move);
        tolerance = max(fine, coarse * min(min(size, move), min(target - lower, upper - target)) / size);
        // A smaller difference of loads is a rounding error of the elastic force.
        least = 1e-14 * (abs(held) + abs(target) * elastic.d[0]);
        most = infinity();
        if (rate == 0) {
            most = direction * (held - balance(system.elastic(start).v, branches.ratio));
            if (!(most > 0)) {
                plan = without(no_two_step, beta_1);
                return false;
            }
        }
        top = direction * (held - (direction > 0 ? wanted.least : wanted.most));
        if (!(top < infinity()))
            top = farthest * (1 + abs(held));
        // From rest beta_p lies between the two holding loads, where it is found, admissible or
        // not.
        top = most < infinity() ? max(top, most) : top;
        guess = first_guess();
        if (!(0 < guess && guess < min(most, top)))
            guess = most < infinity() ? 0.5 * most : 1;
        low = 0, high = most, d = guess;
        pass = times_stuck = 0;
        before.went = infinity();
        rough = wanted.rough;
        return true;
    }
    bool ended(int status)
    {
        plan = without(status, beta_1, pass);
        return true;
    }
    // Uses the turning point of an integration; returns whether the search is over.
    HMSA_APART bool found(const Event &event)
    {
        pass++;
        times_stuck += event.status == stuck;
        if (times_stuck == most_stuck)
            return ended(not_converged);
        const double end = event.stretch, miss = end - target, beta = load();
        const bool turn = event.status == turned;
        double change = infinity(), excess = 0, slope = 0;
        if (turn) {
            excess = log1p(miss / (target - lower)) - log1p(-miss / (upper - target));
            slope = -direction / (event.by_load * (1 / (end - lower) + 1 / (upper - end)));
            change = -excess * slope;
        }
        if (event.status != no_turn && direction * miss > 0)
            low = max(low, d);
        else
            high = min(high, d);
        double next = d + change;
        if (high == infinity() && pass > newton_passes)
            // Newton's method may approach an excess that never vanishes: go to the bound in large
            // steps.
            next = max(next, 4 * d);
        // Relative to beta_p if it is smaller: close to a limit.
        double relative = abs(next - d) / min(d, 1 + abs(beta));
        if (!(low < next && next < high)) {
            const bool lost = high < 8 * least, closed = high - low <= 4e-16 * (abs(held) + high);
            if (tolerance > fine && (lost || closed)) {
                // Coarse integrations have misled the search: start again.
                tolerance = fine;
                low = 0, high = most, d = guess;
                before.went = infinity();
                return pass == most_passes && ended(not_converged);
            }
            if (lost)
                return ended(turn || event.status == no_turn ? indistinguishable : not_converged);
            if (turn && abs(miss) <= 1e-7 * move && (closed || abs(change) <= 1e-13 * d))
                next = d;  // as near as rounding allows
            else if (closed)
                return ended(high < 100 * least ? indistinguishable : not_converged);
            else if (high == infinity())
                next = 4 * d;
            else
                next = low == 0 ? 0.125 * high : 0.5 * (low + high);
            relative = abs(next - d) / min(d, 1 + abs(beta));
        }
        const bool near = rough ? relative < 0.1 && next > 1e-3 * abs(guess)
                                : tolerance <= fine && relative <= enough && abs(miss) <= 1e-6 * move;
        // Cubics through this turning point and the previous one, with both slopes, have an error
        // of the squared product of both distances, Newton's method only that of one distance; the
        // error is larger if Newton's method has made little progress.
        const double nearer = relative / before.went, squared = nearer * nearer;
        const bool bent = !near && turn && !rough && tolerance <= fine && next == d + change
            && relative * before.went <= enough && squared * before.exact <= fine
            && squared * squared * relative <= 0.1 * fine && abs(miss) <= 1e-4 * move;
        if (bent)
            next += beyond_line(-excess / (before.excess - excess), before.d - d,
                before.excess - excess, slope, before.slope);
        if (turn && (near || bent)) {
            if (next < least)
                return ended(indistinguishable);
            const double moved = direction * (next - d), back = direction * (d - before.d);
            plan = {two_step, beta - moved, event.time - event.time_by_load * moved, beta_1, pass};
            if (bent)
                plan.tau_p += beyond_line(
                    -moved / back, before.time - event.time, back, event.time_by_load, before.time_by_load);
            return true;
        }
        before = {d, excess, slope, event.time, event.time_by_load, turn ? relative : infinity(),
            tolerance * (1 + target) / move};
        d = next;
        if (d > top)
            return ended(no_two_step);
        if (relative < 0.1 && tolerance > fine) {
            // The accuracy that convergence requires of the next integration.
            tolerance = max(fine, min(tolerance, 1e-2 * relative * relative));
            const bool last = turn && !rough && abs(excess) < 0.05 && relative * relative * relative < enough;
            if (last || tolerance < 1e3 * fine) {
                tolerance = fine;
                low = 0, high = most;
            }
        }
        return pass == most_passes && ended(not_converged);
    }
};

// Whether the response to the holding load passes the target. Below critical damping it always
// does. Above, it is followed until it has, or until the linearised motion decides: with
// eigenvalues a < b < 0 and deviation x it stays on its side unless (v - a x) x < 0.
template <class System> HMSA_APART bool crosses(const System &system, const double *m, const Move &move, double rtol)
{
    const double target = move.target;
    if (!(m[zeta_at] > 0) || m[zeta_at] < critical_zeta(system, m, target))
        return true;
    const double beta = system.elastic(target).v, omega = frequency(system, target);
    const double half = 0.5 * system.drag * system.shape(target) / system.mass(target);
    const double fast = -half - sqrt(max(half * half - omega * omega, 0.0));
    double y[2] = {move.start, move.rate}, end[2];
    const double side = y[0] - target;
    const double enough = linear * max(
        max(abs(side), abs(y[1] / fast)), min(target - m[lower_at], m[upper_at] - target));
    double h = 4 * sqrt(sqrt(sqrt(rtol))) / (frequency(system, y[0]) + 3 * m[zeta_at] + 1e-9);
    Step<double, 2> step;
    for (int i = 0; i < most_crossing; i++) {
        const double x = y[0] - target;
        if (x * side < 0 || x == 0)
            return true;
        if (abs(x) < enough && abs(y[1]) < enough * abs(fast))
            return (y[1] - fast * x) * x < 0;
        const double error = step([&](int, const double *at, double *by) {
            change(system, Branches<0>{}, at, beta, by);
        }, y, h, rtol, end);
        if (error <= 1)
            y[0] = end[0], y[1] = end[1];
        h *= resized(error);
    }
    return false;
}

// Plans moves from any state, one after the other.
template <class System, int NB = 0> struct Planner {
    Search<System, NB> search;
    Swing<double, System, NB> swing;

    Plan shoot(const System &system, const double *m, const Move &move, double direction, const Wanted &wanted)
    {
        if (!search.begin(system, m, move, direction, wanted))
            return search.plan;
        swing.system = system, swing.branches = search.branches;
        do
            swing.begin(0, search.start, search.rate, search.load(), search.direction, search.move,
                search.frequency_at_start, search.zeta, search.tolerance, search.followed);
        while (!search.found(swing.turn(system)));
        return search.plan;
    }
    // Returns whether a search is needed; otherwise the plan contains the reason.
    HMSA_APART bool begins(const System &system, const double *m, const Move &move, const Wanted &wanted, Plan &plan)
    {
        const double lower = m[lower_at], upper = m[upper_at], target = move.target;
        plan = without(out_of_range);
        if (!(lower < target && target < upper && lower < move.start && move.start < upper))
            return false;
        const double beta_1 = system.elastic(target).v;
        plan = {hold, beta_1, 0, beta_1, 0};
        if (abs(move.start - target) <= wanted.hold
                && abs(move.rate) <= wanted.hold * frequency(system, target))
            return false;
        plan = without(too_damped, beta_1);
        return crosses(system, m, move, max(wanted.rtol, 1e-10));
    }
    // The fastest single intermediate load that ends at rest at the target. There are at most two:
    // one reaches its turning point on the way up and one on the way down (from rest, Eqs. 13 and
    // 14 have only the direct one).
    HMSA_APART Plan operator()(const System &system, const double *m, const Move &move, const Wanted &wanted)
    {
        Plan plan;
        if (!begins(system, m, move, wanted, plan))
            return plan;
        const double up = move.target > move.start ? 1 : -1;
        const auto admissible = [&](const Plan &plan) {
            return plan.status == two_step && wanted.least <= plan.beta_p && plan.beta_p <= wanted.most;
        };
        plan = shoot(system, m, move, up, wanted);
        if (move.rate == 0)
            return plan;
        Plan other = shoot(system, m, move, -up, wanted);
        const int passes = plan.passes + other.passes;
        if ((admissible(other) && (!admissible(plan) || other.tau_p < plan.tau_p))
                || (plan.status != two_step && other.status == two_step))
            plan = other;
        plan.passes = passes;
        return plan;
    }
};
inline bool usable(const double *m, const Move &move, double rest)
{
    return m[zeta_at] >= 0 && m[c1_at] > 0 && m[lower_at] < rest && rest < m[upper_at]
        && finite(m[zeta_at] + m[c1_at] + move.start + move.rate + move.target);
}
}  // namespace hmsa
