// The response to recorded levels with its derivatives by the parameters, in seconds:
//     m(l) l'' + m'(l) l'^2/2 + d l' + a psi'(l) + sum_i gamma_i a (psi'(l) - w_i) = k B + f
//     tau_i w_i' = psi'(l) - w_i        tau_c B' = u - B
// divided by the density and L^2; u is the piecewise linear level of the amplifier. The damping d of
// a block may grow with a power of its stretch. Secondary modes follow the same load, and the sensor
// sees the sum of all modes.
#pragma once
#include "motion.hpp"

namespace hmsa {
// Indices in theta; from first_branch on gamma, tau, flow rule and its constants of each branch, then
// frequency ratio, share, damping ratio and the exponents of ratio and share of each secondary mode.
// Beyond all indices, constant i of the hyperelastic model is the first plus i, and the start time
// of piece m the second plus m. Two forces that are zero in every motion only serve
// differentiation: one against the motion at any rate, and one with the square of the rate.
enum Theta { stiffness_of, damping_of, drive_of, force_of, lag_of, stretch_of, rate_of, exponent_of, first_branch };
constexpr int branch_places = 3 + flow_constants, mode_places = 5;
constexpr int friction_of = 400, square_of = 401, constant_of = 500, switch_of = 1000;
// Rate, relative to the fastest frequency, over which the friction changes sign.
constexpr double soft_rate = 3e-3;

// Maximum phase of a step: the dense output is then accurate to about 1e-8, as are derivatives,
// which vibrate longer than the motion, whose error alone is controlled. Also the maximum step in
// times of the fastest branch: beyond about six the derivatives would grow without bound.
constexpr double longest_phase = 1, relaxed_share = 4;
// The same for secondary modes, which are a part of the motion: it is then accurate to about 3e-7. Fits
// take two thirds of the time, with values that differ by less than 1e-5 of their intervals.
constexpr double longest_phase_of_modes = 1.5;
// Work limits, beyond the needs of any recording, for start values with large errors.
constexpr int most_response_steps = 20000, most_steps_a_sample = 20;

struct Recorded {
    const double *theta, *material;
    int branches, modes;
    int wanted_count;
    const int64_t *wanted;  // indices of the parameters to differentiate by
    const double *start;  // derivatives of the initial stretch by them
    int pieces;
    const double *begins, *levels, *ramps;
    double field, field_lag;  // at the first start, and its derivative by the lag
    int count;
    const double *times;
    double rtol;
    double *stretch, *rate;  // (count,)
    double *jacobian, *by_rate;  // (count, wanted_count); the latter may be null
    // Distance of the branch states from the elastic force, and with secondary modes that of position
    // and rate of each mode from those of all together, at the start, and at the last time; null for
    // zero, and if not needed.
    const double *behind;
    double *behind_last;
    bool damping_varies() const  // whether the damping changes with the stretch
    {
        for (int j = 0; j < wanted_count; j++)
            if (wanted[j] == exponent_of)
                return true;
        return theta[exponent_of] != 0;
    }
    bool by_constants() const
    {
        for (int j = 0; j < wanted_count; j++)
            if (constant_of <= wanted[j] && wanted[j] < switch_of)
                return true;
        return false;
    }
};

// Secondary modes with derivatives by parameters, as `Modes` of system.hpp.
template <class S> struct Modal {
    int count = 0;
    S ratio[most_modes], share[most_modes], damping[most_modes], exponent[most_modes],
        share_exponent[most_modes];
    bool grows[most_modes];  // whether the frequency ratio changes with the stretch
    bool graded = false;  // whether shares change with the stretch
    template <class System, class Bare> HMSA_INLINE void change(const System &system, const Bare &bare,
        const S &a, const S &net, const S *x, const S *at, S *by) const
    {
        constexpr double aside = 1e-4;  // of a central difference
        const real<S> zero{};
        const S &l = x[0];
        const S light = system.acceleration(
            l, S{zero}, S{zero}, [&](const S &) { return S{zero + 1.0}; });
        const double here = get(value(l), 0), stiff = get(value(a), 0);
        const real<S> squared = zero + abs(stiff * bare.elastic(here).d[0] / bare.mass(here)), root = sqrt(squared);
        S square;
        if constexpr (count_of<S> > 0) {
            square = (system.force(l + aside) - system.force(l - aside)) * (0.5 / aside) * light * a;
            square.v = squared;
        } else
            square = squared;
        const S frequency = square * (0.5 / root) + 0.5 * root;
        const S pull = net * light;
        for (int k = 0; k < count; k++, at += 2, by += 2) {
            // The position of a beam may be 0, and its exponent is.
            const S grown = grows[k] && here > 0 ? power(l, exponent[k]) * ratio[k] : ratio[k];
            by[0] = at[1];
            by[1] = grown * grown * (pull + square * (l - at[0])) - frequency * grown * damping[k] * 2.0 * at[1];
        }
    }
    // What a sensor sees of a state: stretch and rate of the first mode, and of the others.
    HMSA_INLINE void seen(const S *y, const S *others, S &stretch, S &rate) const
    {
        S here[most_modes], part = S{} + 1.0, slope{};  // of the sum of shares
        for (int k = 0; k < count; k++) {
            here[k] = share[k];
            if (graded) {
                const double sign = get(value(share[k]), 0) < 0 ? -1 : 1;
                here[k] = here[k] * power(y[0], share_exponent[k]);
                part = part + (here[k] - share[k]) * sign;
                slope = slope + here[k] * share_exponent[k] * sign;
            }
        }
        if (graded)
            part = inverse(part), slope = slope * part;
        stretch = y[0], rate = y[1];
        for (int k = 0; k < count; k++) {
            const S beside = others[2 * k] - y[0];
            S apart = others[2 * k + 1] - y[1];
            if (graded) {
                here[k] = here[k] * part;
                apart = apart + (share_exponent[k] - slope) * y[1] * inverse(y[0]) * beside;
            }
            stretch = stretch + here[k] * beside;
            rate = rate + here[k] * apart;
        }
    }
};

// N of the wanted parameters at a time, from a given one on; the motion is the same to the bit.
template <class C, class System, int NB = most_branches> struct Response {
    using S = C;
    using R = real<S>;
    static constexpr bool modal = NB == most_branches;
    static constexpr int most = room_of<S, NB>, N = count_of<S> * lanes<R>, dense_room = (modal ? most : 2) * size_of<S>;
    const Recorded &of;
    const int from, creeping = modal ? of.branches : NB, width = 2 + creeping + (modal ? 2 * of.modes : 0);
    Response(const Recorded &recorded, int first) : of(recorded), from(first) { step.use(width); }
    System system;
    typename System::Bare bare;  // the system without derivatives
    S a, damping, drive, force, lag, exponent;
    bool damping_varies;  // whether the damping changes with the stretch
    Branches<NB, S> branches;
    Branches<NB> bare_branches;
    std::conditional_t<modal, Modal<S>, char> modes{};
    double level, ramp;
    S excess;  // of the field over the line, at the start of the piece
    double piece_begin, fastest;
    int rubs, squares;  // indices among the derivatives, -1 for none
    Step<S, most, 16> step;

    static S plain(double x) { return S{R{} + x}; }
    static double first(const S &x) { return get(value(x), 0); }
    template <class F> void each(const F &f) const
    {
        for (int j = 0; j < N && from + j < of.wanted_count; j++)
            f(j, int(of.wanted[from + j]));
    }
    S seeded_at(int place) const
    {
        S x = plain(of.theta[place]);
        if constexpr (N > 0)
            each([&](int j, int wanted) { incline(x, j, wanted == place); });
        return x;
    }
    void set_up()
    {
        for (int i = 0; i < lanes<R>; i++)
            system.read(i, of.material);
        bare.read(0, of.material);
        if constexpr (System::direct)
            each([&](int j, int wanted) {
                if (constant_of <= wanted && wanted < switch_of)
                    system.seed(wanted - constant_of, j);
            });
        a = seeded_at(stiffness_of), damping = seeded_at(damping_of), drive = seeded_at(drive_of);
        force = seeded_at(force_of), lag = seeded_at(lag_of), exponent = seeded_at(exponent_of);
        damping_varies = modal && bare.rest > 0 && of.damping_varies();
        rubs = squares = -1;
        each([&](int j, int wanted) {
            rubs = wanted == friction_of ? j : rubs;
            squares = wanted == square_of ? j : squares;
        });
        branches.in_use = creeping;
        for (int b = 0; b < creeping; b++) {
            const int at = first_branch + branch_places * b;
            branches.ratio[b] = seeded_at(at);
            branches.speed[b] = inverse(seeded_at(at + 1));
            bare_branches.speed[b] = first(branches.speed[b]);
            if constexpr (NB == most_branches) {
                branches.flow[b].read(of.theta + at + 2);
                bare_branches.flow[b].read(of.theta + at + 2);
            }
            if constexpr (NB == most_branches && N > 0)
                each([&](int j, int wanted) {
                    if (at + 3 <= wanted && wanted < at + branch_places)
                        branches.flow[b].seed(wanted - at - 3, j);
                });
        }
        if constexpr (modal) {
            modes.count = of.modes;
            for (int k = 0; k < of.modes; k++) {
                const int at = first_branch + branch_places * creeping + mode_places * k;
                modes.ratio[k] = seeded_at(at), modes.share[k] = seeded_at(at + 1);
                modes.damping[k] = seeded_at(at + 2), modes.exponent[k] = seeded_at(at + 3);
                modes.share_exponent[k] = seeded_at(at + 4);
                modes.grows[k] = of.theta[at + 3] != 0, modes.graded |= of.theta[at + 4] != 0;
                each([&](int, int wanted) {
                    modes.grows[k] |= wanted == at + 3, modes.graded |= wanted == at + 4;
                });
            }
        }
    }
    S field(double dt) const
    {
        S now = plain(level + ramp * dt) - lag * ramp;
        if (of.theta[lag_of] > 0)
            now = now + excess * exp(inverse(lag) * -dt);
        return now;
    }
    HMSA_INLINE void change(const S *x, double dt, S *by) const
    {
        S pull = drive * field(dt) + force;
        if constexpr (N > 0) {
            const double v = first(x[1]), soft = soft_rate * fastest;
            if (rubs >= 0)
                incline(pull, rubs, slope(pull, rubs) - v / sqrt(v * v + soft * soft));
            if (squares >= 0)
                incline(pull, squares, slope(pull, squares) - abs(v) * v);
        }
        by[0] = x[1];
        [[maybe_unused]] S net{}, relief{};  // relief: by which the damping is below that at a stretch of 1
        if constexpr (modal)
            if (damping_varies && first(x[0]) > 0)
                pull = pull + (relief = damping * (S{} + 1.0 - power(x[0], exponent)) * x[1]);
        by[1] = system.acceleration(x[0], x[1], damping, [&](const S &elastic)
            __attribute__((always_inline)) {
                S held = elastic;
                branches.hold(elastic, x + 2, by + 2, [&](const S &more)
                    __attribute__((always_inline)) { held = held + more; });
                const S beyond = pull - a * held;
                if constexpr (modal)
                    net = beyond - relief;
                return beyond;
            });
        if constexpr (modal)
            if (modes.count)
                modes.change(system, bare, a, net, x, x + 2 + creeping, by + 2 + creeping);
    }
    // A sample of a state, moved on at its rate for some time.
    void put(int i, const S *y, double after = 0) const
    {
        if constexpr (modal)
            if (modes.count) {
                S stretch, rate;
                modes.seen(y, y + 2 + creeping, stretch, rate);
                return put(i, stretch + rate * after, rate);
            }
        put(i, after ? y[0] + y[1] * after : y[0], y[1]);
    }
    void put(int i, const S &l, const S &v) const
    {
        of.stretch[i] = first(l), of.rate[i] = first(v);
        if constexpr (N > 0)
            each([&](int j, int) {
                of.jacobian[int64_t(i) * of.wanted_count + from + j] = slope(l, j);
                if (of.by_rate)
                    of.by_rate[int64_t(i) * of.wanted_count + from + j] = slope(v, j);
            });
    }
    // Derivatives of the equilibrium stretch under a level.
    void hold(double l, double level, double *slopes)
    {
        set_up();
        const double stiffness = of.theta[stiffness_of] * bare.elastic(l).d[0];
        const S lacks = drive * level + force - a * system.force(plain(l));
        if constexpr (N > 0)
            each([&](int j, int) { slopes[from + j] = slope(lacks, j) / stiffness; });
    }
    bool operator()()
    {
        set_up();
        S y[most] = {}, end[most], at[most] = {};
        R dense[7][dense_room];
        const int shown = width > 2 + creeping ? width * size_of<S>
            : of.by_rate ? 2 * size_of<S> : size_of<S> + 1;  // requested values
        y[0] = plain(of.theta[stretch_of]), y[1] = seeded_at(rate_of);
        if constexpr (N > 0)
            each([&](int j, int) { incline(y[0], j, of.start[from + j]); });
        const auto apart = [&](int i) { return of.behind ? of.behind[i] : 0; };
        for (int w = 2 + creeping; w < width; w++)
            y[w] = y[(w - creeping) % 2] + apart(w);
        for (int i = 0; i < 2 && width > 2 + creeping; i++)
            y[i] = y[i] + apart(creeping + i);
        for (int b = 0; b < creeping; b++)
            y[2 + b] = system.force(y[0]) + apart(b);
        level = of.levels[0], ramp = of.ramps[0], piece_begin = of.begins[0];
        excess = plain(of.field - level) + lag * ramp;
        if constexpr (N > 0)
            each([&](int j, int wanted) {
                if (wanted == lag_of)
                    incline(excess, j, slope(excess, j) + of.field_lag);
            });
        const double stiff = of.theta[stiffness_of];
        fastest = sqrt(stiff / bare.mass(bare.rest));
        double h = 0.2 / fastest, t = of.begins[0];
        bool fresh = true;
        int piece = 0, i = 0;
        const int64_t attempts = most_response_steps + int64_t(most_steps_a_sample) * of.count;
        for (int64_t attempt = 0; attempt < attempts; attempt++) {
            for (; i < of.count && of.times[i] <= t; i++)  // constant rate before the start
                put(i, y, of.times[i] - t);
            if (i == of.count) {
                for (int b = 0; of.behind_last && b < creeping; b++)
                    of.behind_last[b] = first(y[2 + b]) - first(system.force(y[0]));
                if constexpr (modal)
                    if (modes.count && of.behind_last) {
                        S seen[2];
                        modes.seen(y, y + 2 + creeping, seen[0], seen[1]);
                        for (int w = creeping; w < width; w++)
                            of.behind_last[w] = first(y[w < 2 + creeping ? w - creeping : w]) - first(seen[(w - creeping) % 2]);
                    }
                return true;
            }
            const double limit = piece + 1 < of.pieces ? of.begins[piece + 1] : infinity();
            const double l = first(y[0]);
            const double per_phase = sqrt(bare.mass(l) / (stiff * bare.elastic(l).d[0]));
            const double target = min(limit, of.times[of.count - 1]);
            h = min(h, longest_phase * per_phase);
            if constexpr (modal)
                for (int k = 0; k < modes.count; k++)
                    h = min(h, longest_phase_of_modes * per_phase / first(modes.ratio[k]));
            if (of.wanted_count > 0)
                for (int b = 0; b < creeping; b++)
                    h = min(h, relaxed_share / bare_branches.tangent(b, bare.elastic(l).v - first(y[2 + b])));
            const double span = min(h, target - t), dt = t - piece_begin;
            const double error = make(y, fresh, dt, span, end);
            fresh = false;
            if (!(error <= 1)) {
                h = span * resized(error);
                if (!(h > 1e-12 / fastest))
                    return false;
                continue;
            }
            const double after = span == target - t ? target : t + span;
            change(end, after - piece_begin, step.k[12]);
            if (of.times[i] < after)
                step.spread([&](int stage, const S *x, S *by) __attribute__((always_inline)) {
                    change(x, dt + span * dop853::node[stage], by);
                }, y, R{} + span, end, shown, dense, std::make_integer_sequence<int, 4>());
            for (; i < of.count && of.times[i] < after; i++) {
                step.between((of.times[i] - t) / span, y, shown, dense, at);
                put(i, at);
            }
            for (int w = 0; w < width; w++)
                y[w] = end[w], step.k[0][w] = step.k[12][w];
            t = after;
            if (span == h || error > 0.5)
                h = span * resized(error);
            for (; piece + 1 < of.pieces && of.begins[piece + 1] <= t; fresh = true)
                begin(++piece, y);
        }
        return false;
    }
    void begin(int piece, S *y)
    {
        const S before = field(of.begins[piece] - piece_begin);
        piece_begin = of.begins[piece];
        const double jump = of.levels[piece] - first(before);
        level = of.levels[piece], ramp = of.ramps[piece];
        excess = before - level + lag * ramp;
        if constexpr (N > 0)
            if (jump != 0) {
                // By a lag of 0, or by a later switch: the missing part of the step is an impulse.
                const double impulse = first(drive) * jump / bare.mass(first(y[0]));
                each([&](int j, int wanted) {
                    if (wanted == switch_of + piece || (wanted == lag_of && !(of.theta[lag_of] > 0)))
                        incline(y[1], j, slope(y[1], j) - impulse);
                });
            }
    }
    // One step, whose first slope is known unless fresh; rates are relative to natural
    // frequencies.
    double make(const S *y, bool fresh, double dt, double h, S *end)
    {
        return step.scaled([&](int stage, const S *x, S *by) __attribute__((always_inline)) {
            if (stage > 0 || fresh)
                change(x, dt + h * dop853::node[stage], by);
        }, y, h, of.rtol, fastest, end);
    }
};
}  // namespace hmsa
