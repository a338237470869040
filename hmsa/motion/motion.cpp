// Functions of the motion, which do not check values.
#include "bind.hpp"
#include "hmsa/batch.hpp"
#include "hmsa/late.hpp"
#include "hmsa/smooth.hpp"
#include "hmsa/subsets.hpp"
#include "hmsa/tail.hpp"

namespace {
using namespace hmsa;

// -- hyperelastic models ---------------------------------------------------------------------------

enum Quantity { force_q, stiffness_q, energy_q, mass_q, frequency_q, critical_zeta_q, equilibrium_q, damping_q };
double quantity(int what, double x, const double *m)
{
    return with_system(m, [&](const auto &system) -> double {
        switch (what) {
        case force_q: return system.elastic(x).v;
        case stiffness_q: return system.elastic(x).d[0];
        case energy_q: return system.energy(x);
        case mass_q: return system.mass(x);
        case frequency_q: return frequency(system, x);
        case critical_zeta_q: return critical_zeta(system, m, x);
        case equilibrium_q: return equilibrium(system, m, x);
        default: return system.drag * system.shape(x);
        }
    });
}
template <int what> double quantity_of(double x, Numbers material) { return quantity(what, x, material.data); }
Nothing evaluate(int what, Numbers values, Numbers material, Results out)
{
    if (fit(values.count == out.count))
        for (int i = 0; i < out.count; i++)
            out[i] = quantity(what, values[i], material.data);
    return {};
}
Nothing accelerations(Numbers stretch, Numbers rate, Numbers load, Numbers material, Results out)
{
    if (fit(stretch.count == out.count && rate.count == out.count && load.count == out.count))
        with_system(material.data, [&](const auto &system) {
            for (int i = 0; i < out.count; i++) {
                const double x[2] = {stretch[i], rate[i]};
                double by[2];
                change(system, Branches<0>{}, x, load[i], by);
                out[i] = by[1];
            }
        });
    return {};
}
// -- two-step plans ---------------------------------------------------------------------------------

auto turning_point_of(double stretch, double rate, double direction, double load, double move,
    Numbers material, double rtol)
{
    const Event event = with_system(material.data, [&](const auto &system) {
        return hmsa::turning_point(
            system, stretch, rate, direction, load, move, material[zeta_at], rtol);
    });
    return std::tuple{int(event.status), event.time, event.stretch, event.by_load, event.time_by_load};
}
auto two_step_of(double start, double rate, double target, Numbers material, double least, double most,
    double rtol, double hold)
{
    const Plan plan = with_system(material.data, [&](const auto &system) {
        Planner<std::decay_t<decltype(system)>> planner;
        return planner(system, material.data, {start, rate, target}, {least, most, rtol, hold});
    });
    return std::tuple{plan.status, plan.beta_p, plan.tau_p, plan.beta_1, plan.passes};
}
auto two_step_late(double start, double rate, double target, double least, double most, double rtol,
    double hold, Numbers material, Numbers branches, Followed followed, double field, double load,
    double lag)
{
    const int creeping = branches.count / branch_columns;
    const double *known = followed.count == creeping ? followed.values : nullptr;
    Late found{};
    if (fit(creeping <= most_branches))
        found = with_system(material.data, [&](const auto &system) {
            using System = std::decay_t<decltype(system)>;
            return with_branches<double, System>(branches.data, creeping, [&](const auto &all) {
                return late(system, all, material.data, {start, rate, target},
                    {least, most, rtol, hold}, {field, load, lag, branches.data, creeping, known});
            });
        });
    const Plan &plan = found.plan;
    return std::tuple{plan.status, plan.beta_p, plan.tau_p, plan.beta_1, found.push, found.until};
}
// One source, two instruction sets: all of a step is inlined into the function with the attribute.
__attribute__((target("avx2"), flatten)) void plan_wide(const Rows &rows)
{
    plan_lanes<four, Gent>(rows);
}
__attribute__((flatten)) void plan_narrow(const Rows &rows) { plan_lanes<two, Gent>(rows); }
Nothing two_step_batch(Numbers start, Numbers rate, Numbers target, Numbers materials, int stride,
    double least, double most, double rtol, double hold, int wide, Statuses status, Results beta_p,
    Results tau_p, Results beta_1)
{
    const int count = start.count;
    for (const int other : {rate.count, target.count, status.count, beta_p.count, tau_p.count, beta_1.count})
        if (!fit(other == count))
            return {};
    const Rows rows{count, start.data, rate.data, target.data, materials.data, stride,
        {least, most, rtol, hold}, status.data, beta_p.data, tau_p.data, beta_1.data};
    if (count > 0)
        apart([&] {
            if (int(materials[kind_at]) > neo_hookean)
                plan_rows<Any>(rows);
            else if (wide && __builtin_cpu_supports("avx2"))
                plan_wide(rows);
            else
                plan_narrow(rows);
            return Nothing{};
        });
    return {};
}

// -- motion over time -------------------------------------------------------------------------------

// Returns the number of actuators whose integration fails.
int follow(int first, int last, Array<const bool> wanted, Results state, Results drive, Numbers material,
    Results branches, Numbers durations, double rtol, Statuses status)
{
    const int rows = durations.count;
    if (!fit(state.count == 3 * rows && drive.count == 4 * rows && status.count == rows
            && wanted.count == rows && first >= 0 && last <= rows
            && (!branches.count || branches.count == branch_columns * most_rows * rows)))
        return 0;
    const Plant plant{state.data, drive.data, material.data, rows ? material.count / rows : 0,
        branches.count ? branches.data : nullptr, durations.data, rtol};
    int failed = 0;
    for (int i = first; i < last; i++) {
        if (!wanted[i])
            continue;
        int creeping = 0;
        const double *own = plant.branches + branch_columns * most_rows * i;
        const double *packed = plant.material + int64_t(plant.stride) * i;
        if (plant.branches)
            while (creeping < most_rows && own[branch_columns * creeping + speed_at] > 0)
                creeping++;
        const bool done = with_system(packed,
            [&](const auto &system) {
                using System = std::decay_t<decltype(system)>;
                return with_branches<double, System>(own, creeping, [&](const auto &all) {
                    return advance_row(plant, i, system, all);
                });
            });
        status[i] = done ? turned : stuck;
        failed += !done;
    }
    return failed;
}
// Returns whether the motion was followed to its end.
bool sample_of(double stretch, double rate, double field, Numbers switches, Numbers loads, Numbers slopes,
    double lag, Numbers times, Numbers material, Numbers branches, double rtol, Results out)
{
    const int creeping = branches.count / branch_columns;
    if (!fit(loads.count == switches.count && slopes.count == switches.count && switches.count
            && out.count == (3 + creeping) * times.count && creeping <= most_rows))
        return false;
    const Course course{switches.count, times.count, switches.data, loads.data, slopes.data, times.data,
        stretch, rate, field, lag, material[zeta_at], rtol, branches.data, creeping, out.data};
    return apart([&] {
        return with_system(material.data, [&](const auto &system) {
            using System = std::decay_t<decltype(system)>;
            return with_branches<double, System>(branches.data, creeping, [&](const auto &all) {
                return sample(system, all, course);
            });
        });
    });
}

// Computes the flow rates of branches with given stresses over their ratios, (count,).
Nothing flow_rates(Numbers branches, Numbers above, Results out)
{
    const int creeping = above.count;
    if (fit(branches.count == branch_columns * creeping && out.count == creeping && creeping <= most_branches)) {
        Branches<most_branches> all;
        all.read(branches.data, creeping);
        for (int b = 0; b < creeping; b++)
            out[b] = all.rate(b, above[b]);
    }
    return {};
}
// Computes branch states, (times, count), for an elastic force that is linear between times.
bool trail_of(Numbers times, Numbers forces, Numbers branches, Results out)
{
    const int creeping = branches.count / branch_columns;
    return fit(forces.count == times.count && out.count == times.count * creeping && creeping <= most_branches)
        && trail({times.count, times.data, forces.data, branches.data, creeping, out.data});
}

// -- levels ---------------------------------------------------------------------------------------

// Returns whether it is solved, the duration, and the work.
std::tuple<bool, double, int> solve(Results times, Results loads, Numbers d_times, Numbers d_loads,
    double stretch, double rate, double field, double load, double target, double slew, double lag,
    Numbers material, Numbers branches, Numbers followed, int most_work)
{
    const int levels = times.count, unknowns = levels ? d_times.count / levels : 0;
    const int creeping = followed.count;
    if (!fit(levels && loads.count == levels && d_times.count == unknowns * levels
            && d_loads.count == unknowns * levels && branches.count == branch_columns * creeping
            && levels <= most_levels && unknowns <= most_unknowns && creeping <= most_rows))
        return {};
    const Shot shot{levels, unknowns, times.data, loads.data, d_times.data, d_loads.data, stretch, rate,
        field, load, target, slew, lag, branches.data, creeping, followed.data, most_work};
    double lasts = 0;
    int work = 0;
    const bool solved = with_system(material.data, [&](const auto &system) {
        using System = std::decay_t<decltype(system)>;
        const auto with = [&](auto p) {
            Shooting<System, p()> shooting{system, shot};
            const bool found = shooting.solve(material.data, lasts);
            work = shooting.work;
            return found;
        };
        if (unknowns <= 2)
            return with(fixed<2>);
        if constexpr (has_own_code<System>)
            if (unknowns == 3)
                return with(fixed<3>);
        if (unknowns <= 4)
            return with(fixed<4>);
        if (unknowns <= 6)
            return with(fixed<6>);
        return with(fixed<most_unknowns>);
    });
    return {solved, lasts, work};
}
// Returns whether there are levels, and writes them and their changes by unit conditions.
bool smooth(double phase, int rings, Numbers modes, double bent, Results out)
{
    const int rows = 1 + 2 * rings, levels = out.count / rows;
    return fit(0 < rings && rings <= most_rings && modes.count % 3 == 0 && modes.count >= 3 * rings
            && out.count == rows * levels && 0 < levels && levels <= most_equal)
        && Smooth{levels, rings, modes.count / 3 - rings, phase, modes.data, bent, out.data}();
}
// Returns the number of levels and an upper bound of their vibration.
std::tuple<int, double> staircase(Numbers behind, Numbers branches, double stretch, Numbers material,
    double lag, double period, double end, double ripple, Results out)
{
    Tail tail{};
    tail.count = behind.count;
    if (!fit(branches.count == branch_columns * tail.count && tail.count <= most_branches))
        return {};
    tail.behind = behind.data, tail.rows = branches.data;
    tail.lag = lag, tail.period = period, tail.until = end;
    tail.out = out.data, tail.room = out.count / columns;
    double most = 0;
    const int found = with_system(material.data, [&](const auto &system) {
        tail.set_up(system, stretch);
        return tail.staircase(ripple, most);
    });
    return {found, most};
}

// -- linear systems -----------------------------------------------------------------------------------

// Solves a symmetric system for each subset of its unknowns, a row of the arrays after the matrix,
// in place; writes the logarithms of the determinants.
Nothing subsets(Numbers matrix, Array<const bool> varies, Results values, Results log_dets)
{
    const int rows = log_dets.count, count = rows ? varies.count / rows : 0;
    if (fit(!rows || (count <= most_subset && matrix.count == count * count && varies.count == rows * count
            && values.count == rows * count)))
        for (int i = 0; i < rows; i++) {
            const Subset subset(count, matrix.data, varies.data + i * count);
            subset.solve(values.data + i * count);
            log_dets[i] = subset.log_det();
        }
    return {};
}
// Adds the inverses over subsets of the unknowns, with weights, to a matrix.
Nothing subset_inverses(Numbers matrix, Array<const bool> varies, Numbers weights, Results out)
{
    const int rows = weights.count, count = rows ? varies.count / rows : 0;
    if (fit(!rows || (count <= most_subset && matrix.count == count * count && varies.count == rows * count
            && out.count == matrix.count)))
        for (int i = 0; i < rows; i++)
            if (weights[i] != 0)
                Subset(count, matrix.data, varies.data + i * count).add_inverse(weights[i], count, out.data);
    return {};
}

PyMethodDef methods[] = {
    method<quantity_of<force_q>>("elastic_force"),
    method<quantity_of<stiffness_q>>("elastic_stiffness"),
    method<quantity_of<energy_q>>("elastic_energy"),
    method<quantity_of<mass_q>>("mass"),
    method<quantity_of<frequency_q>>("natural_frequency"),
    method<quantity_of<critical_zeta_q>>("critical_zeta"),
    method<quantity_of<equilibrium_q>>("equilibrium_stretch"),
    method<quantity_of<damping_q>>("damping"),
    method<evaluate>("evaluate"), method<accelerations>("accelerations"),
    method<turning_point_of>("turning_point"),
    method<two_step_of>("two_step"), method<two_step_late>("two_step_late"),
    method<two_step_batch>("two_step_batch"), method<follow>("follow"),
    method<sample_of>("sample"), method<flow_rates>("flow_rates"), method<trail_of>("trail"),
    method<solve>("solve"), method<smooth>("smooth"), method<staircase>("staircase"),
    method<subsets>("subsets"), method<subset_inverses>("subset_inverses"), {nullptr, nullptr, 0, nullptr}};
PyModuleDef module = {PyModuleDef_HEAD_INIT, "_motion", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};
}  // namespace

PyMODINIT_FUNC PyInit__motion() { return PyModule_Create(&module); }
