// Python bindings of the motion: functions over numbers and buffers, which do not check values.
// `bound` converts their arguments and results.
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <tuple>
#ifdef __SSE2__
#include <xmmintrin.h>
#endif
#include "hmsa/batch.hpp"
#include "hmsa/late.hpp"
#include "hmsa/response.hpp"
#include "hmsa/smooth.hpp"
#include "hmsa/subsets.hpp"
#include "hmsa/tail.hpp"

namespace {
using namespace hmsa;
using GentBlock = Block<double, Gent>;

// Calls f with the actuator type of a packed material.
template <class F> auto with_system(const double *m, const F &f)
{
    if (int(m[kind_at]) > neo_hookean) {
        Any system;
        system.read(0, m);
        return f(system);
    }
    GentBlock system;
    system.read(0, m);
    return f(system);
}
template <int n> constexpr std::integral_constant<int, n> fixed{};

// Flushes subnormal numbers to 0 while it exists. Decaying values, such as branches, the field of a
// coil and their derivatives, become subnormal, which is ten times slower on x86.
class Flushed {
#ifdef __SSE2__
    const unsigned before = _mm_getcsr();

public:
    Flushed() { _mm_setcsr(before | 0x8040); }  // results, operands
    ~Flushed() { _mm_setcsr(before); }
#endif
};

// -- arguments and results -----------------------------------------------------------------------

// A contiguous array owned by the caller.
template <class T> struct Array {
    T *data;
    int count;
    T &operator[](int i) const { return data[i]; }
};
using Numbers = Array<const double>;
using Results = Array<double>;
using Places = Array<const int64_t>;
using Statuses = Array<int64_t>;

template <class T> struct Argument;
template <> struct Argument<double> {
    double got;
    bool read(PyObject *from)
    {
        got = PyFloat_AsDouble(from);
        return got != -1 || !PyErr_Occurred();
    }
};
template <> struct Argument<int> {
    int got;
    bool read(PyObject *from)
    {
        got = int(PyLong_AsLong(from));
        return got != -1 || !PyErr_Occurred();
    }
};
// Released at the end.
template <class T> struct Argument<Array<T>> {
    Py_buffer view{};
    Array<T> got{};
    bool read(PyObject *from)
    {
        using Number = std::remove_const_t<T>;
        constexpr bool numbers = std::is_same_v<Number, double>, truth = std::is_same_v<Number, bool>;
        constexpr const char *types = numbers ? "d" : truth ? "?" : "lq";
        constexpr int writable = std::is_const_v<T> ? 0 : PyBUF_WRITABLE;
        if (PyObject_GetBuffer(from, &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | writable) != 0)
            return false;
        if (!std::strchr(types, view.format[0])) {
            PyErr_Format(PyExc_TypeError, "array of type %s: expected one of %s", view.format, types);
            return false;
        }
        got = {static_cast<T *>(view.buf), int(view.len / Py_ssize_t(sizeof(T)))};
        return true;
    }
    Argument() = default;
    Argument(const Argument &) = delete;
    ~Argument() { PyBuffer_Release(&view); }
};
// The states of the branches, or nothing.
struct Followed {
    double values[most_branches];
    int count;
};
template <> struct Argument<Followed> {
    Followed got;
    bool read(PyObject *from)
    {
        got.count = int(PyTuple_Size(from));
        for (int b = 0; b < got.count && b < most_branches; b++)
            got.values[b] = PyFloat_AsDouble(PyTuple_GET_ITEM(from, b));
        return !PyErr_Occurred();
    }
};
bool fit(bool is)
{
    if (!is)
        PyErr_SetString(PyExc_ValueError, "expected arrays that fit each other");
    return is;
}

PyObject *made(double x) { return PyFloat_FromDouble(x); }
PyObject *made(int x) { return PyLong_FromLong(x); }
PyObject *made(bool x) { return PyBool_FromLong(x); }
struct Nothing {};
PyObject *made(Nothing) { Py_RETURN_NONE; }
template <class... T> PyObject *made(const std::tuple<T...> &all)
{
    PyObject *out = PyTuple_New(sizeof...(T));
    int i = 0;
    std::apply([&](const T &...x) { (PyTuple_SET_ITEM(out, i++, made(x)), ...); }, all);
    return out;
}
template <class R, class... A, size_t... I> PyObject *call(
    R (*f)(A...), PyObject *const *from, Py_ssize_t count, std::index_sequence<I...>)
{
    if (count != sizeof...(A))
        return PyErr_Format(PyExc_TypeError, "expected %zu arguments, got %zd", sizeof...(A), count);
    std::tuple<Argument<A>...> arguments;
    if (!(std::get<I>(arguments).read(from[I]) && ...))
        return nullptr;
    const R result = [&] {
        [[maybe_unused]] const Flushed flushed;
        return f(std::get<I>(arguments).got...);
    }();
    return PyErr_Occurred() ? nullptr : made(result);
}
template <class R, class... A> PyObject *call(R (*f)(A...), PyObject *const *from, Py_ssize_t count)
{
    return call(f, from, count, std::index_sequence_for<A...>{});
}
template <auto f> PyObject *bound(PyObject *, PyObject *const *arguments, Py_ssize_t count)
{
    return call(f, arguments, count);
}
// Releases the interpreter lock during work.
template <class F> auto apart(const F &f)
{
    PyThreadState *state = PyEval_SaveThread();
    const auto result = f();
    PyEval_RestoreThread(state);
    return result;
}

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

// -- recordings --------------------------------------------------------------------------------------

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
    if (!fit(branches >= 0 && branches <= most_branches && modal >= 0 && modal <= mode_places * most_modes
            && modal % mode_places == 0
            && start.count == wanted.count && begins.count && levels.count == begins.count
            && ramps.count == begins.count && stretch.count == times.count && rate.count == times.count
            && jacobian.count == cells && (!by_rate.count || by_rate.count == cells)
            && (!behind.count || behind.count == branches)
            && (!behind_last.count || behind_last.count == branches)))
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
    const double l = quantity(equilibrium_q, pull / theta[stiffness_of], of.material);
    for (int from = 0; from < of.wanted_count; from += 8)
        if (int(material[kind_at]) > neo_hookean)
            Response<Eight, AnyOf<Eight>>(of, from).hold(l, level, slopes.data);
        else
            Response<Eight, Block<Eight, Gent>>(of, from).hold(l, level, slopes.data);
    return hmsa::finite(quantity(stiffness_q, l, of.material)) ? l : __builtin_nan("");
}

// Solves a symmetric system for each subset of its unknowns, a row of the arrays after the matrix,
// in place; writes the logarithms of the determinants.
Nothing subsets(Numbers matrix, Array<const bool> varies, Results values, Results log_dets)
{
    const int rows = log_dets.count, count = rows ? varies.count / rows : 0;
    if (fit(!rows || (count <= most_subset && matrix.count == count * count && varies.count == rows * count
            && values.count == rows * count)))
        for (int i = 0; i < rows; i++)
            log_dets[i] = solve_subset(count, matrix.data, varies.data + i * count, values.data + i * count);
    return {};
}

template <auto f> PyMethodDef method(const char *name)
{
    return {name, (PyCFunction)(void (*)())bound<f>, METH_FASTCALL, nullptr};
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
    method<respond>("respond"), method<rest>("rest"),
    method<subsets>("subsets"), {nullptr, nullptr, 0, nullptr}};
PyModuleDef module = {PyModuleDef_HEAD_INIT, "_motion", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};
}  // namespace

PyMODINIT_FUNC PyInit__motion() { return PyModule_Create(&module); }
