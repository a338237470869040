// Motion with derivatives, for recordings; as `motion.cpp`, which is compiled at the same time.
#include "bind.hpp"
#include "hmsa/response.hpp"

namespace {
using namespace hmsa;

using Eight = Dual<double, 8>;
template <class S, class System, int NB = most_branches> bool respond_as(const Recorded &of, int from)
{
    Response<S, System, NB> response{of, from};
    return response();
}
// As for a batch: one source, two instruction sets.
template <class S, int NB> __attribute__((target("avx2"), flatten)) bool respond_wide(
    const Recorded &of, int from)
{
    return respond_as<S, Block<S, Gent>, NB>(of, from);
}
bool respond_gent(const Recorded &of, int from)
{
    if (!__builtin_cpu_supports("avx2"))
        return respond_as<Eight, Block<Eight, Gent>>(of, from);
    // The most common case of identification has its own code.
    if (of.branches == 0 && of.modes == 0 && !of.damping_varies() && of.wanted_count - from <= 4)
        return respond_wide<Dual<four, 1>, 0>(of, from);
    if (of.branches == 1 && of.modes == 0 && !of.damping_varies() && of.theta[first_branch + 2] == maxwell)
        return respond_wide<Dual<four, 2>, 1>(of, from);
    return respond_wide<Dual<four, 2>, most_branches>(of, from);
}
bool respond_part(const Recorded &of, int from)
{
    const int left = of.wanted_count - from;
    if (int(of.material[kind_at]) > neo_hookean)
        return of.by_constants() ? respond_as<Eight, AnyOf<Eight>>(of, from)
            : left > 0 ? respond_as<Eight, Any>(of, from) : respond_as<double, Any>(of, from);
    return left > 0 ? respond_gent(of, from) : respond_as<double, Block<double, Gent>>(of, from);
}
bool respond_all(const Recorded &of)
{
    int from = 0;
    do
        if (!respond_part(of, from))
            return false;
    while ((from += 8) < of.wanted_count);
    return true;
}
// Returns whether the motion was followed to its end.
bool respond(Numbers theta, Numbers material, int branches, Places wanted, Numbers start, Numbers begins,
    Numbers levels, Numbers ramps, double field, double field_lag, Numbers times, double rtol,
    Results stretch, Results rate, Results jacobian, Results by_rate, Numbers behind, Results behind_last)
{
    const int64_t cells = int64_t(times.count) * wanted.count;
    const int64_t modal = theta.count - first_branch - branch_places * branches;
    const int64_t states = branches + (modal ? 2 + 2 * (modal / mode_places) : 0);
    if (!fit(branches >= 0 && branches <= most_branches && modal >= 0 && modal <= mode_places * most_modes
            && modal % mode_places == 0
            && start.count == wanted.count && begins.count && levels.count == begins.count
            && ramps.count == begins.count && stretch.count == times.count && rate.count == times.count
            && jacobian.count == cells && (!by_rate.count || by_rate.count == cells)
            && (!behind.count || behind.count == states)
            && (!behind_last.count || behind_last.count == states)))
        return false;
    Recorded of{};
    of.theta = theta.data, of.material = material.data, of.branches = branches;
    of.modes = int(modal / mode_places);
    of.wanted_count = wanted.count, of.wanted = wanted.data, of.start = start.data;
    of.pieces = begins.count, of.begins = begins.data, of.levels = levels.data, of.ramps = ramps.data;
    of.field = field, of.field_lag = field_lag, of.rtol = rtol;
    of.count = times.count, of.times = times.data, of.stretch = stretch.data, of.rate = rate.data;
    of.jacobian = jacobian.data, of.by_rate = by_rate.count ? by_rate.data : nullptr;
    of.behind = behind.count ? behind.data : nullptr;
    of.behind_last = behind_last.count ? behind_last.data : nullptr;
    return apart([&] { return respond_all(of); });
}
// Returns the equilibrium stretch under a level, NaN if there is none, and writes its derivatives
// by the wanted parameters.
double rest(Numbers theta, Numbers material, double level, Places wanted, Results slopes)
{
    if (!fit(theta.count >= first_branch && wanted.count == slopes.count))
        return 0;
    Recorded of{};
    of.theta = theta.data, of.material = material.data;
    of.wanted_count = wanted.count, of.wanted = wanted.data;
    const double pull = theta[drive_of] * level + theta[force_of];
    const double l = with_system(of.material,
        [&](const auto &system) { return equilibrium(system, of.material, pull / theta[stiffness_of]); });
    for (int from = 0; from < of.wanted_count; from += 8)
        if (int(material[kind_at]) > neo_hookean)
            Response<Eight, AnyOf<Eight>>(of, from).hold(l, level, slopes.data);
        else
            Response<Eight, Block<Eight, Gent>>(of, from).hold(l, level, slopes.data);
    const double stiffness = with_system(of.material, [&](const auto &system) { return system.elastic(l).d[0]; });
    return hmsa::finite(stiffness) ? l : __builtin_nan("");
}

PyMethodDef methods[] = {method<respond>("respond"), method<rest>("rest"), {nullptr, nullptr, 0, nullptr}};
PyModuleDef module = {PyModuleDef_HEAD_INIT, "_derivatives", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};
}  // namespace

PyMODINIT_FUNC PyInit__derivatives() { return PyModule_Create(&module); }
