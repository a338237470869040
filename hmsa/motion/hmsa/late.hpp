// The two-step command with viscoelastic branches and a lagging field: stretch, rate and field
// arrive together, by a short additional push that settles the field.
#pragma once
#include "shooting.hpp"
#include "two_step.hpp"

namespace hmsa {
struct Late {
    Plan plan;
    double push, until;  // level and end of the push from tau_p on; beta_1 without a lag
};
struct Before {
    double field, load;  // at the start, as loads: field, and output of the amplifier
    double lag;
    const double *branches;  // (branch_count, branch_columns)
    int branch_count;
    const double *followed;  // null if relaxed
};

template <int NB, class System> Late late(const System &system, const Branches<NB> &branches, const double *m,
    const Move &move, const Wanted &wanted, const Before &before)
{
    // Duration of the push, in time constants: the push exceeds the holding level by as much as
    // the previous level falls short of it.
    constexpr double length = 0.6931471805599453;
    Planner<System, NB> planner;
    auto &search = planner.search;
    search.branches = branches;
    for (int b = 0; b < branches.count(); b++)
        search.followed[b] = before.followed ? before.followed[b] : system.elastic(move.start).v;
    const bool lags = before.lag > 0;
    Late found{planner(system, m, move, {wanted.least, wanted.most, wanted.rtol, wanted.hold, lags}), 0, 0};
    Plan &plan = found.plan;
    found.push = plan.beta_1, found.until = plan.tau_p;
    if (plan.status != two_step || !lags)
        return found;
    double field = plan.beta_1;
    for (int b = 0; b < branches.count(); b++)
        field += search.branches.ratio[b] * (plan.beta_1 - planner.swing.end[2 + b].v);
    const double span = length * before.lag, turn = plan.tau_p + span;
    double times[3] = {0, turn, turn + span}, loads[3] = {plan.beta_p, 2 * field - plan.beta_p, plan.beta_1};
    const double d_times[9] = {0, 0, 0, 0, 0, 1, 0, 0, 1}, d_loads[9] = {1, 0, 0, 0, 1, 0, 0, 0, 0};
    const Shot shot{3, 3, times, loads, d_times, d_loads, move.start, move.rate, before.field,
        before.load, move.target, infinity(), before.lag, before.branches, before.branch_count,
        search.followed, most_attempts};
    // Models without their own code share that of four unknowns.
    Shooting<System, has_own_code<System> ? 3 : 4> shooting{system, shot};
    double lasts;
    if (!shooting.solve(m, lasts))
        plan.status = not_converged;
    plan.beta_p = loads[0], plan.tau_p = times[1];
    found.push = loads[1], found.until = times[2];
    return found;
}
}  // namespace hmsa
