// Levels with free values, changed until they end at rest at a target: Newton's method, with
// derivatives from the integration.
#pragma once
#include "motion.hpp"

namespace hmsa {
constexpr int most_levels = 304;
// Stretch, rate, field, and load, and position and rate of each mode, are conditions; there are
// more unknowns than conditions if each mode has one more level.
constexpr int most_unknowns = 4 + 3 * most_modes;

struct Shot {
    int levels, unknowns;
    double *times, *loads;  // (levels,), changed in place
    const double *d_times, *d_loads;  // (levels, unknowns)
    double stretch, rate;
    double field, load;  // at the start, as loads: field, and output of the amplifier
    double target, slew, lag;
    const double *branches;  // (branch_count, branch_columns)
    int branch_count;
    const double *followed;
    int most_work;
};

template <class System, int P> struct Shooting {
    // Tolerances of the integrations: first, far from the solution and near it, absolute and
    // relative to the move; and the relative distance from rest below which the final one applies.
    static constexpr double first = 1e-6, rough = 1e-8, rough_share = 1e-7, fine_most = 1e-12,
        fine_share = 1e-11, fine_least = 1e-13, near = 2e-4;
    // With secondary modes, whose guesses are near.
    static constexpr double modal_rough = 1e-5, modal_share = 1e-5, modal_last = 1e-11;
    // A ramp that misses the next level by less counts as reaching it.
    static constexpr double reached = 1e-12;
    static constexpr int most = 25;
    // Minimum fraction of a Newton step; and maximum ratio of trial values to the first guess.
    static constexpr double least_share = 0.01, farthest_trial = 10;
    // Relative to the move: the error left by the last step, and the accepted error if rounding
    // ends the search. And the maximum ratio of distances in successive fine integrations.
    static constexpr double last = 1e-12, accepted = 1e-10, slowest = 0.1;
    // Rounding error of any move.
    static constexpr double rounded = 1e-12;

    const System &system;
    const Shot &shot;
    Shooting(const System &a, const Shot &b) : system(a), shot(b) {}
    double zeta;
    const double *material;  // packed
    Branches<most_branches> branches;
    int count;  // number of pieces
    double duration[2 * most_levels], begin[2 * most_levels], slope[2 * most_levels];
    double d_duration[2 * most_levels][P], d_begin[2 * most_levels][P];
    // Stretch, rate, field, branches, modes.
    double end[3 + most_rows], d_end[3 + most_rows][P];
    double miss[most_unknowns], trial[most_unknowns][P];  // one row per unknown
    double frequency_at_target, stiffness, force;
    double first_times[most_levels], first_loads[most_levels];
    int conditions;
    int work = 0;  // steps, times the number of values and derivatives

    bool modal() const { return branches.modes.count > 0; }
    // Computes the pieces of the load and their derivatives; false if a ramp does not fit.
    bool cut()
    {
        const int n = shot.unknowns;
        count = 0;
        double load = shot.load, d_load[P] = {}, d_span[P] = {};
        for (int i = 0; i < shot.levels; i++) {
            const bool is_last = i == shot.levels - 1;
            double span = 0;
            for (int c = 0; c < n; c++)
                d_span[c] = is_last ? 0 : shot.d_times[(i + 1) * n + c] - shot.d_times[i * n + c];
            if (!is_last)
                span = shot.times[i + 1] - shot.times[i];
            if (shot.slew < infinity()) {
                const double sign = shot.loads[i] < load ? -1 : 1;
                duration[count] = abs(shot.loads[i] - load) / shot.slew;
                begin[count] = load;
                slope[count] = sign * shot.slew;
                span -= duration[count];
                for (int c = 0; c < n; c++) {
                    d_duration[count][c] = sign * (shot.d_loads[i * n + c] - d_load[c]) / shot.slew;
                    d_begin[count][c] = d_load[c];
                    d_span[c] -= d_duration[count][c];
                }
                count++;
            }
            if (!is_last) {
                if (span < -reached)
                    return false;
                duration[count] = max(span, 0.0);
                begin[count] = shot.loads[i];
                slope[count] = 0;
                for (int c = 0; c < n; c++) {
                    d_duration[count][c] = d_span[c];
                    d_begin[count][c] = shot.d_loads[i * n + c];
                }
                count++;
            }
            load = shot.loads[i];
            for (int c = 0; c < n; c++)
                d_load[c] = shot.d_loads[i * n + c];
        }
        return count > 0;
    }
    double whole() const
    {
        double sum = 0;
        for (int m = 0; m < count; m++)
            sum += duration[m];
        return sum;
    }
    template <class S> static S with(double x, const double *d)
    {
        if constexpr (count_of<S> > 0) {
            S made{x, {}};
            for (int c = 0; c < count_of<S>; c++)
                made.d[c] = d[c];
            return made;
        } else
            return x;
    }
    // Integrates the pieces; with derivatives if S has them.
    template <class S> bool respond(double rtol)
    {
        return with_branches<S, System>(shot.branches, shot.branch_count, [&](const auto &branches) {
            return respond<S>(branches, rtol);
        });
    }
    template <class S, int NB> bool respond(const Branches<NB> &branches, double rtol)
    {
        Motion<S, System, NB> motion{system, branches};
        motion.y[0] = motion.y[0] + shot.stretch;
        motion.y[1] = motion.y[1] + shot.rate;
        for (int b = 0; b < branches.rows(); b++)
            motion.y[2 + b] = motion.y[2 + b] + shot.followed[b];
        S field = 0.0 * motion.y[0] + shot.field;
        double h = 0;
        for (int m = 0; m < count; m++) {
            auto drive = following(with<S>(begin[m], d_begin[m]), slope[m], shot.lag, field);
            h = modal() ? h : 0;  // many pieces, which change little
            constexpr int each = 2 + count_of<S>;
            motion.room = min(most_attempts, (shot.most_work - work) / each);
            const int before = motion.made;
            const bool there = motion.advance(drive, duration[m], zeta, rtol, h);
            work += each * (motion.made - before);
            if (!there)
                return false;
            drive.go_on(duration[m]);
            field = drive.load();
            if constexpr (count_of<S> > 0) {
                // By the duration of the piece: the derivative is the equation of motion at its
                // end.
                S by[room_of<S, NB>];
                change(system, branches, motion.y, field, by);
                const double change = slope[m] - value(drive.rest) * drive.decay;
                for (int c = 0; c < shot.unknowns; c++) {
                    for (int w = 0; w < motion.width; w++)
                        motion.y[w].d[c] += by[w].v * d_duration[m][c];
                    field.d[c] += change * d_duration[m][c];
                }
            }
        }
        const auto put = [&](int row, const S &x) {
            end[row] = value(x);
            if constexpr (count_of<S> > 0)
                for (int c = 0; c < shot.unknowns; c++)
                    d_end[row][c] = x.d[c];
        };
        put(0, motion.y[0]), put(1, motion.y[1]), put(2, field);
        for (int b = 0; b < branches.rows(); b++)
            put(3 + b, motion.y[2 + b]);
        return true;
    }
    // Distance of the end from rest at the target, in units of stretch, and its derivatives. The
    // conditions are stretch, rate, field (if it lags), with branches and a ramping amplifier its
    // last load, from which the next levels start, and position and rate of each mode. At most as
    // many count as there are unknowns.
    double missed(bool derivatives)
    {
        const int n = derivatives ? shot.unknowns : 0;
        miss[0] = end[0] - shot.target, miss[1] = end[1] / frequency_at_target;
        for (int c = 0; c < n; c++)
            trial[0][c] = d_end[0][c], trial[1][c] = d_end[1][c] / frequency_at_target;
        int row = 2;
        if (shot.lag > 0) {
            miss[row] = (end[2] - force) / stiffness;
            for (int c = 0; c < n; c++)
                trial[row][c] = d_end[2][c] / stiffness;
            row++;
        }
        const bool ramps = shot.slew < infinity();
        if (branches.count() > 0 && ramps) {
            miss[row] = (shot.loads[shot.levels - 1] - force) / stiffness;
            for (int c = 0; c < n; c++)
                trial[row][c] = shot.d_loads[(shot.levels - 1) * shot.unknowns + c] / stiffness;
            row++;
        }
        for (int b = 0; b < branches.count(); b++)
            // The field has to balance the overstress, and the amplifier to lead it.
            for (int i = 2; i < row; i++) {
                const double share = branches.ratio[b] / stiffness;
                Dual<double, 1> above{force - end[3 + b], {1}};
                if (i + 1 == row && ramps)
                    above = above - branches.rate(b, above) * shot.lag;
                miss[i] -= share * above.v;
                for (int c = 0; c < n; c++)
                    trial[i][c] += share * above.d[0] * d_end[3 + b][c];
            }
        for (int k = 0; k < branches.modes.count && row + 1 < shot.unknowns; k++, row += 2) {
            const int at = 3 + branches.count() + 2 * k;
            // As a unit of rates, without the exponent.
            const double frequency = frequency_at_target * branches.modes.ratio[k];
            miss[row] = end[at] - shot.target, miss[row + 1] = end[at + 1] / frequency;
            for (int c = 0; c < n; c++) {
                trial[row][c] = d_end[at][c];
                trial[row + 1][c] = d_end[at + 1][c] / frequency;
            }
        }
        conditions = min(row, shot.unknowns);
        double squares = 0;
        for (int i = 0; i < conditions; i++)
            squares += miss[i] * miss[i];
        return sqrt(squares);
    }
    // The Newton step, by elimination: the smallest one if there are more unknowns than conditions.
    void newton(const double (*jacobian)[P], double *step) const
    {
        if (conditions == shot.unknowns)
            return eliminate(jacobian, step);
        double square[P][P] = {}, along[P];
        for (int i = 0; i < conditions; i++)
            for (int j = 0; j < conditions; j++)
                for (int c = 0; c < shot.unknowns; c++)
                    square[i][j] += jacobian[i][c] * jacobian[j][c];
        eliminate(square, along);
        for (int c = 0; c < shot.unknowns; c++) {
            step[c] = 0;
            for (int i = 0; i < conditions; i++)
                step[c] += jacobian[i][c] * along[i];
        }
    }
    void eliminate(const double (*jacobian)[P], double *step) const
    {
        const int n = conditions;
        double work[P][P + 1];
        for (int i = 0; i < n; i++) {
            for (int j = 0; j < n; j++)
                work[i][j] = jacobian[i][j];
            work[i][n] = -miss[i];
        }
        for (int i = 0; i < n; i++) {
            int best = i;
            for (int j = i + 1; j < n; j++)
                if (abs(work[j][i]) > abs(work[best][i]))
                    best = j;
            for (int m = 0; m <= n; m++) {
                const double kept = work[i][m];
                work[i][m] = work[best][m], work[best][m] = kept;
            }
            for (int j = i + 1; j < n; j++) {
                const double factor = work[j][i] / work[i][i];
                for (int m = i; m <= n; m++)
                    work[j][m] -= factor * work[i][m];
            }
        }
        for (int i = n - 1; i >= 0; i--) {
            double x = work[i][n];
            for (int j = i + 1; j < n; j++)
                x -= work[i][j] * step[j];
            step[i] = x / work[i][i];
        }
    }
    void place(const double *x, double share, const double *step)
    {
        for (int i = 0; i < shot.levels; i++) {
            double time = first_times[i], load = first_loads[i];
            for (int c = 0; c < shot.unknowns; c++) {
                const double moved = x[c] + share * step[c];
                time += shot.d_times[i * shot.unknowns + c] * moved;
                load += shot.d_loads[i * shot.unknowns + c] * moved;
            }
            shot.times[i] = time, shot.loads[i] = load;
        }
    }
    // Coarse integrations give the derivatives and a guess for fine ones, which measure the end
    // without derivatives. Returns whether it is solved, and the duration including the last ramp.
    bool solve(const double *packed, double &lasts)
    {
        using S = Dual<double, P>;
        const int n = shot.unknowns, levels = shot.levels;
        lasts = __builtin_nan("");
        material = packed, zeta = material[zeta_at];
        branches.read(shot.branches, shot.branch_count);
        const auto elastic = system.elastic(shot.target);
        force = elastic.v, stiffness = elastic.d[0];
        frequency_at_target = frequency(system, shot.target);
        double high = 0;
        for (int i = 0; i < levels; i++) {
            first_times[i] = shot.times[i], first_loads[i] = shot.loads[i];
            high = max(high, abs(shot.loads[i]));
        }
        double move = abs(shot.target - shot.stretch) + abs(shot.rate) / frequency_at_target;
        if (shot.lag > 0)
            move += abs(shot.field - shot.loads[levels - 1]) / stiffness;
        const double farthest_load = farthest_trial * (high + abs(shot.load) + 1);
        const double longest = farthest_trial * shot.times[levels - 1];
        double x[P] = {}, step[P] = {}, jacobian[most_unknowns][P] = {};
        double share = 1, size = infinity(), before = infinity();
        const double fine = max(fine_least, min(fine_most, fine_share * move));
        double rtol = max(fine, modal() ? min(modal_rough, modal_share * move) : min(rough, rough_share * move));
        double tolerance = modal() ? rtol : max(rtol, min(first, rough_share * move));
        bool measuring = false;
        for (int pass = 0; pass < most && work < shot.most_work;) {
            place(x, share, step);
            double now = infinity();
            high = 0;
            for (int i = 0; i < levels; i++)
                high = max(high, abs(shot.loads[i]));
            // An extreme trial is not integrated.
            const bool fits = high < farthest_load && shot.times[levels - 1] < longest && cut();
            if (fits && (measuring ? respond<double>(tolerance) : respond<S>(tolerance)))
                now = missed(!measuring);
            pass++;
            if (measuring) {
                lasts = fits ? whole() : lasts;
                const bool slow = !(now < slowest * before);
                if (slow && now <= max(accepted * move, rounded))
                    return true;  // as near as rounding allows
                if (slow && (rtol == fine || !(now < infinity())))
                    return false;
                if (slow) {  // the derivatives were too coarse
                    measuring = false;
                    rtol = tolerance = fine;
                    size = infinity();
                    continue;
                }
                newton(jacobian, step);
                for (int c = 0; c < n; c++)
                    x[c] += step[c];
                before = now, share = 0;
                // With derivatives from this distance, about that fraction remains.
                if (now * size <= (modal() ? modal_last : last) * move * move) {
                    place(x, share, step);
                    const bool still = cut();
                    lasts = whole();
                    return still;
                }
                continue;
            }
            if (!(now < (1 - 0.1 * share) * size)) {
                share *= 0.5;
                if (size == infinity() || !(share > least_share))
                    return false;
                pass--;
                continue;
            }
            for (int c = 0; c < n; c++)
                x[c] += share * step[c];
            size = now, tolerance = rtol;
            std::memcpy(jacobian, trial, sizeof jacobian);
            newton(jacobian, step);
            for (int c = 0; c < n; c++)
                if (!finite(step[c]))
                    return false;
            share = 1;
            if (size <= max(near * move, 10 * rounded)) {
                measuring = true;
                tolerance = fine, before = infinity();
                for (int c = 0; c < n; c++)
                    x[c] += step[c];
                share = 0;
            }
        }
        return false;
    }
};
}  // namespace hmsa
