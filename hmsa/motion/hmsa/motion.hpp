// Motion over time, with viscoelastic branches and a coil that lags. If the output of the
// amplifier is linear in time, the lagging field is the sum of a line and an exponential.
#pragma once
#include "swing.hpp"

namespace hmsa {
constexpr int most_attempts = 200000;

// A load: line + slope t + rest exp(-decay t).
template <class S> struct Drive {
    S line;
    double slope;
    S rest;
    double decay;

    S load() const { return line + rest; }
    void go_on(double duration)
    {
        line = line + slope * duration;
        rest = rest * exp(-decay * duration);
    }
};
// The load of a field that lags behind an amplifier output begin + slope t.
template <class S> Drive<S> following(const S &begin, double slope, double lag, const S &field)
{
    const S line = begin - slope * lag;
    return {line, slope, lag > 0 ? S(field - line) : S(0.0 * line), lag > 0 ? 1 / lag : 0};
}

template <class S, class System, int NB> struct Motion {
    const System &system;
    const Branches<NB> &branches;
    const int width = 2 + branches.rows();
    S y[room_of<S, NB>] = {};  // stretch, rate, branch states
    Step<S, room_of<S, NB>> step;
    int room = most_attempts, made = 0;  // maximum and actual number of steps in a piece
    Motion(const System &a, const Branches<NB> &b) : system(a), branches(b) { step.use(width); }

    // Integrates over a duration; h is the initial step, 0 if unknown, and then the next step.
    // Motion too close to a limiting stretch to be resolved reverses there, in no time and without
    // loss.
    HMSA_APART bool advance(const Drive<S> &drive, double duration, double zeta, double rtol, double &h)
    {
        const bool fades = drive.decay > 0 && (value(drive.rest) != 0 || count_of<S> > 0);
        const double stiff = sqrt(branches.total), root = sqrt(sqrt(sqrt(rtol)));
        if (!(h > 0)) {
            const double first = 4 * root / (frequency(system, value(y[0])) + 3 * zeta + 1e-9);
            const double fastest = max(branches.fastest, value(drive.rest) != 0 ? drive.decay : 0);
            h = 1 / (stiff / first + 0.25 / root * fastest);
        }
        S end[room_of<S, NB>];
        double done = 0;
        for (int i = 0; i < room; i++, made++) {
            const double left = duration - done;
            if (!(left > 0))
                return true;
            const double span = min(h, left), l = value(y[0]), v = value(y[1]);
            const double felt = rounding * abs(l) * stiff * frequency(system, l) / (1 + abs(v));
            if (felt > resolved && v * (l - system.rest) > 0)
                negate(y[1]);
            const S line = drive.line + drive.slope * done;
            const S rest = fades ? S(drive.rest * exp(-drive.decay * done)) : S(0.0 * drive.rest);
            const double error = step([&](int stage, const S *x, S *by)
                __attribute__((always_inline)) {
                    const double t = span * dop853::node[stage];
                    S load = line + drive.slope * t;
                    if (fades)
                        load = load + rest * exp(-drive.decay * t);
                    change(system, branches, x, load, by);
                }, y, span, max(rtol, felt), end);
            if (!(error <= 1)) {
                h = span * resized(error);
                continue;
            }
            for (int w = 0; w < width; w++)
                y[w] = end[w];
            done = span == left ? duration : done + span;
            if (span == h || error > 0.5)
                h = span * resized(error);
        }
        return false;
    }
    static void negate(double &x) { x = -x; }
    template <int N> static void negate(Dual<double, N> &x) { x.v = -x.v; }
};

// The remaining fraction of an exponential after a duration; 0 if it would vanish in a sum.
inline double faded(double line, double rest, double decay, double duration)
{
    rest *= exp(-decay * duration);
    return abs(rest) > 1e-17 * (1e-3 + abs(line)) ? rest : 0;
}

// Actuators that are advanced together, each by its own duration: rows of stretch, rate and step,
// of the drive, of the packed material, and of branches and modes (most_rows, branch_columns).
struct Plant {
    double *state, *drive;
    const double *material;
    int stride;
    double *branches;  // null without branches and modes
    const double *durations;
    double rtol;
};
template <int NB, class System> bool advance_row(
    const Plant &plant, int i, const System &system, const Branches<NB> &branches)
{
    double *state = plant.state + 3 * i, *drive = plant.drive + 4 * i;
    double *rows = plant.branches ? plant.branches + branch_columns * most_rows * i : nullptr;
    Motion<double, System, NB> motion{system, branches};
    motion.y[0] = state[0], motion.y[1] = state[1];
    for (int b = 0; b < branches.rows(); b++)
        motion.y[2 + b] = rows[branch_columns * b + follower_at];
    const double duration = plant.durations[i];
    const double zeta = plant.material[int64_t(plant.stride) * i + zeta_at];
    double h = state[2];
    if (!motion.advance({drive[0], drive[1], drive[2], drive[3]}, duration, zeta, plant.rtol, h))
        return false;
    state[0] = motion.y[0], state[1] = motion.y[1], state[2] = h;
    for (int b = 0; b < branches.rows(); b++)
        rows[branch_columns * b + follower_at] = motion.y[2 + b];
    const double line = drive[0];
    drive[0] += drive[1] * duration;
    if (drive[2] != 0)
        drive[2] = faded(line, drive[2], drive[3], duration);
    return true;
}

// Samples at increasing times of the response to an amplifier whose output is loads[m] +
// slopes[m] (t - switches[m]) from switches[m] on; the motion begins at the first switch, which is
// not after the first time. Rows of out (3 + branch_count, count) are stretch, rate, field and
// those of branches and modes.
struct Course {
    int pieces, count;
    const double *switches, *loads, *slopes, *times;
    double stretch, rate, field, lag, zeta, rtol;
    const double *branches;  // (branch_count, branch_columns)
    int branch_count;
    double *out;
};
template <int NB, class System> bool sample(
    const System &system, const Branches<NB> &branches, const Course &course)
{
    Motion<double, System, NB> motion{system, branches};
    motion.y[0] = course.stretch, motion.y[1] = course.rate;
    for (int b = 0; b < branches.rows(); b++)
        motion.y[2 + b] = course.branches[branch_columns * b + follower_at];
    const auto piece_from = [&](int piece, double field) {
        return following(course.loads[piece], course.slopes[piece], course.lag, field);
    };
    Drive<double> drive = piece_from(0, course.field);
    double t = course.switches[0], h = 0;
    for (int i = 0, piece = 0; i < course.count;) {
        const bool ends = piece + 1 < course.pieces && course.switches[piece + 1] <= course.times[i];
        const double end = ends ? course.switches[piece + 1] : course.times[i];
        if (!motion.advance(drive, end - t, course.zeta, course.rtol, h))
            return false;
        drive.go_on(end - t);
        t = end;
        if (ends) {
            drive = piece_from(++piece, drive.load());
            h = 0;
            continue;
        }
        double *column = course.out + i++;
        column[0] = motion.y[0];
        column[course.count] = motion.y[1];
        column[2 * course.count] = drive.load();
        for (int b = 0; b < branches.rows(); b++)
            column[(3 + b) * course.count] = motion.y[2 + b];
    }
    return true;
}

// Branch states for an elastic force given at times, and linear in between; initial states are in
// the rows of the branches.
struct Trail {
    int count;
    const double *times, *forces, *branches;
    int branch_count;
    double *out;  // (count, branch_count)
};
inline bool trail(const Trail &of)
{
    constexpr double rtol = 1e-13;
    Branches<most_branches> branches;
    branches.read(of.branches, of.branch_count);
    Step<double, 1> step;
    for (int b = 0; b < of.branch_count; b++) {
        // In terms of the distance from the force; exact for a linear rule, and for constant force.
        double x = of.forces[0] - of.branches[branch_columns * b + follower_at], end, h = 0;
        for (int i = 0; i < of.count; i++) {
            const double span = i ? of.times[i] - of.times[i - 1] : 0;
            const double slope = span != 0 ? (of.forces[i] - of.forces[i - 1]) / span : 0;
            if (branches.flow[b].kind == maxwell) {
                const double faded = expm1(-branches.speed[b] * span);
                x += faded * (x - slope / branches.speed[b]);
            } else if (slope == 0)
                x = branches.flow[b].relaxed(x, branches.speed[b], span);
            else {
                double left = span;
                for (int n = 0; left > 0; n++) {
                    if (n == most_attempts)
                        return false;
                    h = min(h > 0 ? h : 0.1 / branches.tangent(b, x), left);
                    const double scale = abs(x) + 1e-9;  // errors are relative to the present value
                    double y = x / scale;
                    const double error = step([&](int, const double *at, double *by) {
                        *by = (slope - branches.rate(b, *at * scale)) / scale;
                    }, &y, h, rtol, &end);
                    if (error <= 1)
                        x = end * scale, left -= h;
                    h *= resized(error);
                }
            }
            of.out[i * of.branch_count + b] = of.forces[i] - x;
        }
    }
    return true;
}
}  // namespace hmsa
