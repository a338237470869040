// Motion under a constant load up to its first turning point in a direction, with derivatives by
// the load. R double: one motion. R lanes: several in lock-step; exceptional cases are decided one
// lane at a time, only by its own values, so that each lane is bit for bit a single motion.
#pragma once
#include "system.hpp"

namespace hmsa {
enum Turn { turned, no_turn, stuck, too_close, goes_on };
// A turning point: its time and stretch, and their derivatives by the load.
struct Event {
    Turn status;
    double time, stretch, by_load, time_by_load;
};

// Maximum steps of a swing, of a slow approach to an equilibrium, and of the search in the last
// step.
constexpr int most_steps = 20000, most_creeping = 2000, most_inside = 60;
// A distance from an equilibrium below this fraction of the move counts as rest.
constexpr double at_rest = 1e-12;
// Rounding the stretch to a part in 2^52 changes the acceleration by this fraction of l omega^2.
// If this exceeds the tolerance, motion close to a limiting stretch is not resolved.
constexpr double rounding = 3e-16, resolved = 1e-8;

template <class R, class System, int NB = 0> struct Swing {
    static constexpr int n = lanes<R>, W = 2 + NB;
    static constexpr int most = NB ? most_creeping : most_steps;
    using S = Dual<R, 1>;
    using D = Dual<double, 1>;
    using Mask = decltype(R{} < R{});
    System system;
    Branches<NB> branches;
    S y[W], end[W];
    R beta, sign, h, t, rtol;
    R still, calm;  // a rate and an acceleration below both are rest
    R room;  // beyond this, rounding affects l omega
    R error, squared, slope, steps;  // of the last step
    Mask inside;  // whether the turning point is searched within a step
    Mask special;  // whether a lane needs a decision
    struct Bracket {
        double before, after, size, enough;
    } bracket[n];
    Step<S, W> step;

    HMSA_INLINE int width() const { return 2 + branches.count(); }
    static bool has(const Mask &mask, int i)
    {
        if constexpr (n == 1)
            return mask;
        else
            return mask[i];
    }
    static void put(Mask &mask, int i, bool is)
    {
        if constexpr (n == 1)
            mask = is;
        else
            mask[i] = -int64_t(is);
    }
    static bool any(const Mask &mask)
    {
        if constexpr (n == 1)
            return mask;
        else {
            int64_t found = 0;
            for (int i = 0; i < n; i++)
                found |= mask[i];
            return found;
        }
    }
    // From a state, with the length relative to which closeness to an equilibrium is measured, the
    // natural frequency at the start, and zeta.
    HMSA_APART void begin(int i, double l, double v, double load, double direction, double move,
        double frequency, double zeta, double tolerance, const double *followed = nullptr)
    {
        step.use(width());
        for (int w = 0; w < width(); w++) {
            set(y[w].v, i, w == 0 ? l : w == 1 ? v : followed[w - 2]);
            set(y[w].d[0], i, 0);
        }
        set(beta, i, load);
        set(sign, i, direction);
        set(rtol, i, tolerance);
        const double fast = frequency + 3 * zeta, root = sqrt(sqrt(sqrt(tolerance)));
        // A fixed phase of the local oscillation, whose frequency vanishes at extrema of the force.
        set(h, i, 7 * root / (fast + 1e-9));
        set(t, i, 0);
        set(steps, i, 0);
        set(still, i, at_rest * move * fast);
        set(calm, i, at_rest * move * fast * fast);
        set(room, i, min(tolerance, resolved) / rounding);
        put(inside, i, false);
        // The final Taylor series has an error of third order in the remaining time.
        bracket[i] = {0, 0, 0, root * root * root};
    }
    void idle(int i)
    {
        set(h, i, 0);
        set(steps, i, -infinity());
        put(inside, i, false);
    }
    // Makes one step of all lanes; returns whether some of them need a decision.
    HMSA_INLINE bool advance()
    {
        const S load{beta, {R{} + 1.0}};
        error = step([&](int stage, const S *x, S *change) {
            hmsa::change(system, branches, x, load, change, stage == 0 ? &squared : nullptr);
        }, y, h, rtol, end);
        slope = step.k[0][1].v;
        steps = steps + 1.0;
        const R speed = abs(y[1].v), felt = room * (1.0 + speed);
        const auto good = error <= 1.0;
        special = (good & (sign * y[1].v > 0.0) & (sign * end[1].v <= 0.0)) | inside
            | (y[0].v * y[0].v * abs(squared) > felt * felt)
            | ((speed < still) & (abs(slope) < calm)) | (steps > double(most));
        const auto moves = good & !special;
        for (int w = 0; w < width(); w++) {
            y[w].v = select(moves, end[w].v, y[w].v);
            y[w].d[0] = select(moves, end[w].d[0], y[w].d[0]);
        }
        t = select(moves, R(t + h), t);
        h = select(special, h, R(h * resized(error)));
        return any(special);
    }
    // Decides on a lane, whose system for one motion is given.
    template <class One> Event decide(int i, const One &one)
    {
        return has(inside, i) ? land(i, one) : look(i);
    }
    HMSA_APART Event look(int i)
    {
        const double l = get(y[0].v, i), v = get(y[1].v, i), w = get(end[1].v, i);
        const double all = get(h, i), direction = get(sign, i), a = get(slope, i);
        const double kept = rounding * abs(l) * sqrt(abs(get(squared, i))) / (1 + abs(v));
        const auto over = [&](Turn status) -> Event {
            return {status, get(t, i), l, get(y[0].d[0], i), 0};
        };
        if (kept > resolved)
            return over(too_close);
        if (abs(v) < get(still, i) && abs(a) < get(calm, i))
            return over(no_turn);
        if (get(steps, i) > most)
            return over(stuck);
        // Relative to the accuracy that rounding allows in a step.
        const double counted = get(error, i) * (get(rtol, i) / max(get(rtol, i), kept));
        if (!(counted <= 1 && direction * v > 0 && direction * w <= 0)) {
            if (counted <= 1) {
                for (int m = 0; m < width(); m++) {
                    set(y[m].v, i, get(end[m].v, i));
                    set(y[m].d[0], i, get(end[m].d[0], i));
                }
                set(t, i, get(t, i) + all);
            }
            set(h, i, all * resized(counted));
            return {goes_on, 0, 0, 0, 0};
        }
        // A step of suitable length from the same start: by the secant or, if the start
        // decelerates, by the parabola through both rates and that slope.
        double dt = all * v / (v - w);
        if (direction * a < 0) {
            const double c = (w - v - a * all) / (all * all), root = a * a - 4 * c * v;
            if (root > 0)
                dt = 2 * v / (-a + direction * sqrt(root));
        }
        bracket[i].before = 0, bracket[i].after = all;
        bracket[i].size = max(abs(v), abs(w));
        set(steps, i, 0);
        put(inside, i, true);
        return again(i, dt);
    }
    template <class One> HMSA_APART Event land(int i, const One &one)
    {
        const double w = get(end[1].v, i), all = get(h, i), direction = get(sign, i);
        D at[W], by[W];
        for (int m = 0; m < width(); m++)
            at[m] = {get(end[m].v, i), {get(end[m].d[0], i)}};
        change(one, branches, at, D{get(beta, i), {1}}, by);
        const D &x = at[0], &u = at[1], &a = by[1];
        // Without deceleration the trial is too early or too late: reject it, so that it is
        // bisected.
        double left = -1 - all;
        if (direction * a.v < 0) {
            // The jerk is the derivative along the motion.
            D along[W], further[W];
            for (int m = 0; m < width(); m++)
                along[m] = {at[m].v, {by[m].v}};
            change(one, branches, along, get(beta, i), further);
            const double jerk = further[1].d[0];
            left = -w / a.v;
            left -= 0.5 * jerk / a.v * left * left;
            if (abs(w) <= bracket[i].enough * bracket[i].size)
                return {turned, get(t, i) + all + left,
                    x.v + left * (w + left * (0.5 * a.v + jerk / 6 * left)),
                    x.d[0] + left * (u.d[0] + 0.5 * a.d[0] * left),
                    -(u.d[0] + a.d[0] * left) / (a.v + jerk * left)};
        }
        if (get(steps, i) > most_inside)  // as near as rounding allows
            return {turned, get(t, i) + all, x.v, x.d[0], -u.d[0] / a.v};
        (direction * w > 0 ? bracket[i].before : bracket[i].after) = all;
        return again(i, all + left);
    }
    // The first turning point of one motion, after initialisation.
    HMSA_APART Event turn(const System &one)
    {
        for (;;)
            if (advance()) {
                const Event event = decide(0, one);
                if (event.status != goes_on)
                    return event;
            }
    }
    Event again(int i, double dt)
    {
        const Bracket &in = bracket[i];
        set(h, i, in.before < dt && dt < in.after ? dt : 0.5 * (in.before + in.after));
        return {goes_on, 0, 0, 0, 0};
    }
};

// The first turning point of one motion.
template <class System> Event turning_point(const System &system, double l, double v,
    double direction, double load, double move, double zeta, double tolerance)
{
    Swing<double, System> swing{};
    swing.system = system;
    swing.begin(0, l, v, load, direction, move, frequency(system, l), zeta, tolerance);
    return swing.turn(system);
}
}  // namespace hmsa
