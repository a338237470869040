// Levels with free numbers, moved until they end at rest at a target: Newton, with the derivatives
// that come out of the integration.
#pragma once
#include "motion.hpp"

namespace hmsa {
constexpr int most_levels = 304, most_unknowns = 4;  // stretch, rate, field, and load

struct Shot {
    int levels, unknowns;
    double *times, *loads;  // (levels,), moved in place
    const double *d_times, *d_loads;  // (levels, unknowns)
    double stretch, rate;
    double field, load;  // in force at the start, and the amplifier's
    double target, slew, lag;
    const double *branches;  // (branch_count, branch_columns)
    int branch_count;
    const double *followed;
    int most_work;
};

template <class System, int P> struct Shooting {
    // Tolerances of the first pass, far from the solution and at it, the largest and as shares of
    // the move; and the distance from rest, as a share, from which on it is measured with the last.
    static constexpr double first = 1e-6, rough = 1e-8, rough_share = 1e-7, fine_most = 1e-12,
        fine_share = 1e-11, fine_least = 1e-13, near = 2e-4;
    // A ramp that misses the next level by less has just reached it.
    static constexpr double reached = 1e-12;
    static constexpr int most = 25;
    // A Newton step that must be cut shorter leads nowhere; and trials leave the first guess by
    // this factor at the most.
    static constexpr double least_share = 0.01, farthest_trial = 10;
    // As shares of the move: what the last step may leave, and what is accepted where rounding ends
    // the search. And the share of the distance that a fine pass has to leave less than.
    static constexpr double last = 1e-12, accepted = 1e-10, slowest = 0.1;
    // What rounding leaves of any move.
    static constexpr double rounded = 1e-12;

    const System &system;
    const Shot &shot;
    Shooting(const System &a, const Shot &b) : system(a), shot(b) {}
    double zeta;
    Branches<most_branches> branches;
    int count;  // of pieces
    double duration[2 * most_levels], begin[2 * most_levels], slope[2 * most_levels];
    double d_duration[2 * most_levels][P], d_begin[2 * most_levels][P];
    double end[3 + most_branches], d_end[3 + most_branches][P];  // stretch, rate, field, followers
    double miss[most_unknowns], trial[most_unknowns][P];  // as many rows as unknowns
    double frequency_at_target, stiffness, force;
    double first_times[most_levels], first_loads[most_levels];
    int work = 0;  // steps, each as often as it has numbers of a kind

    // Fills in the pieces of the load and their derivatives; false if a ramp does not fit.
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
    // Follows the pieces; with derivatives where S has them.
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
        for (int b = 0; b < branches.count(); b++)
            motion.y[2 + b] = motion.y[2 + b] + shot.followed[b];
        S field = 0.0 * motion.y[0] + shot.field;
        for (int m = 0; m < count; m++) {
            auto drive = following(with<S>(begin[m], d_begin[m]), slope[m], shot.lag, field);
            double h = 0;
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
                // By the length of the piece: the equation at its end.
                S by[2 + NB];
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
        for (int b = 0; b < branches.count(); b++)
            put(3 + b, motion.y[2 + b]);
        return true;
    }
    // How far the end is from rest at the target, in units of stretch, and the derivatives: the
    // stretch, the rate, where the field lags the field, and where branches hold and the amplifier
    // ramps its last load, from which the next levels go on.
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
        if (shot.branch_count > 0 && ramps) {
            miss[row] = (shot.loads[shot.levels - 1] - force) / stiffness;
            for (int c = 0; c < n; c++)
                trial[row][c] = shot.d_loads[(shot.levels - 1) * shot.unknowns + c] / stiffness;
            row++;
        }
        for (int b = 0; b < shot.branch_count; b++)
            // What a branch holds the field has to balance, and the amplifier to lead.
            for (int i = 2; i < row; i++) {
                const double share = branches.ratio[b] / stiffness;
                Dual<double, 1> above{force - end[3 + b], {1}};
                if (i + 1 == row && ramps)
                    above = above - branches.rate(b, above) * shot.lag;
                miss[i] -= share * above.v;
                for (int c = 0; c < n; c++)
                    trial[i][c] += share * above.d[0] * d_end[3 + b][c];
            }
        double squares = 0;
        for (int i = 0; i < shot.unknowns; i++)
            squares += miss[i] * miss[i];
        return sqrt(squares);
    }
    // The Newton step, by elimination.
    void newton(const double (*jacobian)[P], double *step) const
    {
        const int n = shot.unknowns;
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
    // Coarse passes bring the derivatives and a guess for those that measure the end finely,
    // without derivatives. Returns whether it is solved; and the duration, the last ramp included.
    bool solve(const double *material, double &lasts)
    {
        using S = Dual<double, P>;
        const int n = shot.unknowns, levels = shot.levels;
        lasts = __builtin_nan("");
        zeta = material[zeta_at];
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
        double rtol = max(fine, min(rough, rough_share * move));
        double tolerance = max(rtol, min(first, rough_share * move));
        bool measuring = false;
        for (int pass = 0; pass < most && work < shot.most_work;) {
            place(x, share, step);
            double now = infinity();
            high = 0;
            for (int i = 0; i < levels; i++)
                high = max(high, abs(shot.loads[i]));
            // A wild trial is not worth its integration.
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
                // Derivatives of so far away leave about that share.
                if (now * size <= last * move * move) {
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
