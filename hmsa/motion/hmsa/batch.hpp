// Many moves at once; those from rest run several in lock-step if the hyperelastic model allows
// it.
#pragma once
#include "two_step.hpp"

namespace hmsa {
struct Rows {
    int count;
    const double *start, *rate, *target, *materials;
    int stride;  // values from one material to the next; 0 for a common material
    Wanted wanted;
    int64_t *status;
    double *beta_p, *tau_p, *beta_1;

    Move move(int row) const { return {start[row], rate[row], target[row]}; }
    const double *material(int row) const { return materials + int64_t(row) * stride; }
    void write(int row, const Plan &plan) const
    {
        status[row] = plan.status, beta_p[row] = plan.beta_p;
        tau_p[row] = plan.tau_p, beta_1[row] = plan.beta_1;
    }
};

template <class System> void plan_rows(const Rows &rows)
{
    Planner<System> planner{};
    for (int row = 0; row < rows.count; row++) {
        const double *m = rows.material(row);
        System system;
        system.read(0, m);
        rows.write(row, usable(m, rows.move(row), system.rest)
            ? planner(system, m, rows.move(row), rows.wanted) : without(bad_input));
    }
}

// A lane whose move is done takes the next one, so that no lane waits. The plan of a row is bit
// for bit the same in any batch, and alone.
template <class R, template <class> class Law>
HMSA_INLINE void plan_lanes(const Rows &rows)
{
    using One = Block<double, Law>;
    constexpr int n = lanes<R>;
    Planner<One> planner{};
    Search<One> search[n];
    Swing<R, Block<R, Law>> swing{};
    int row_of[n], next = 0, busy = 0;
    const auto begin_pass = [&](int i) {
        const auto &s = search[i];
        swing.begin(i, s.start, s.rate, s.load(), s.direction, s.move, s.frequency_at_start,
            s.zeta, s.tolerance);
    };
    const auto fill = [&](int i) {
        for (; next < rows.count; next++) {
            const double *m = rows.material(next);
            const Move move = rows.move(next);
            One system;
            system.read(0, m);
            Plan plan;
            if (!usable(m, move, system.rest)) {
                rows.write(next, without(bad_input));
                continue;
            }
            if (!planner.begins(system, m, move, rows.wanted, plan)) {
                rows.write(next, plan);
            } else if (move.rate != 0) {
                rows.write(next, planner(system, m, move, rows.wanted));
            } else if (!search[i].begin(
                    system, m, move, move.target > move.start ? 1 : -1, rows.wanted)) {
                rows.write(next, search[i].plan);
            } else {
                swing.system.read(i, m);
                begin_pass(i);
                row_of[i] = next++;
                return true;
            }
        }
        return false;
    };
    for (int i = 0; i < n; i++) {
        row_of[i] = -1;
        if (fill(i)) {
            busy++;
        } else {  // idles beside the others
            swing.system.read(i, rows.materials);
            swing.begin(i, 1, 0, 0, 1, 1, 1, 0, 1e-7);
            swing.idle(i);
        }
    }
    while (busy > 0) {
        if (!swing.advance())
            continue;
        for (int i = 0; i < n; i++) {
            if (row_of[i] < 0 || !swing.has(swing.special, i))
                continue;
            const Event event = swing.decide(i, search[i].system);
            if (event.status == goes_on)
                continue;
            if (!search[i].found(event)) {
                begin_pass(i);
                continue;
            }
            rows.write(row_of[i], search[i].plan);
            if (!fill(i)) {
                row_of[i] = -1;
                swing.idle(i);
                busy--;
            }
        }
    }
}
}  // namespace hmsa
