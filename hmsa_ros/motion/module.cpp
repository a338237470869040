// The motion as Python has it: functions over numbers and buffers, which check no values.
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include "hmsa/batch.hpp"
#include "hmsa/response.hpp"
#include "hmsa/shooting.hpp"
#include "hmsa/tail.hpp"

namespace {
using namespace hmsa;
using GentBlock = Block<double, Gent>;

// Calls f with the actuator of a packed material.
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
// Calls f with as many branches as there are, or with some that hold nothing.
template <class F> auto with_branches(int count, const F &f)
{
    if (count == 0)
        return f(std::integral_constant<int, 0>{});
    if (count == 1)
        return f(std::integral_constant<int, 1>{});
    return f(std::integral_constant<int, most_branches>{});
}

// -- arguments -----------------------------------------------------------------------------------

// A contiguous array of double, int64 or bool, given back at the end; not there where there is an
// error, which is set.
struct Buffer {
    Py_buffer view{};
    bool there;
    explicit Buffer(PyObject *from, bool writable = false, const char *types = "d")
        : there(PyObject_GetBuffer(
              from, &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0)) == 0)
    {
        if (there && !std::strchr(types, view.format[0])) {
            PyErr_Format(PyExc_TypeError, "array of type %s: expected one of %s", view.format, types);
            PyBuffer_Release(&view);
            there = false;
        }
    }
    Buffer(const Buffer &) = delete;
    ~Buffer()
    {
        if (there)
            PyBuffer_Release(&view);
    }
    double *numbers() const { return static_cast<double *>(view.buf); }
    int count() const { return int(view.len / Py_ssize_t(sizeof(double))); }
};
constexpr const char *whole = "lq", *truth = "?";
bool refused(const char *function, Py_ssize_t expected, Py_ssize_t got)
{
    if (got != expected)
        PyErr_Format(PyExc_TypeError, "%s: expected %zd arguments, got %zd", function, expected, got);
    return got != expected;
}
bool differ(const char *function)
{
    PyErr_Format(PyExc_ValueError, "%s: expected arrays that fit each other", function);
    return false;
}
// Reads numbers; false where one is none, which is set as the error.
bool read(PyObject *const *from, int count, double *to)
{
    for (int i = 0; i < count; i++)
        to[i] = PyFloat_AsDouble(from[i]);
    return !PyErr_Occurred();
}
using Arguments = PyObject *const *;

// -- the law ---------------------------------------------------------------------------------------

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
template <int what> PyObject *quantity_of(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double x;
    if (refused("a quantity of the law", 2, count) || !read(arguments, 1, &x))
        return nullptr;
    const Buffer material(arguments[1]);
    return material.there ? PyFloat_FromDouble(quantity(what, x, material.numbers())) : nullptr;
}
PyObject *evaluate(PyObject *, Arguments arguments, Py_ssize_t count)
{
    if (refused("evaluate", 4, count))
        return nullptr;
    const long what = PyLong_AsLong(arguments[0]);
    const Buffer values(arguments[1]), material(arguments[2]), out(arguments[3], true);
    if (!values.there || !material.there || !out.there || PyErr_Occurred())
        return nullptr;
    if (values.count() != out.count() && !differ("evaluate"))
        return nullptr;
    for (int i = 0; i < out.count(); i++)
        out.numbers()[i] = quantity(int(what), values.numbers()[i], material.numbers());
    Py_RETURN_NONE;
}
PyObject *accelerations(PyObject *, Arguments arguments, Py_ssize_t count)
{
    if (refused("accelerations", 5, count))
        return nullptr;
    const Buffer l(arguments[0]), v(arguments[1]), load(arguments[2]), material(arguments[3]),
        out(arguments[4], true);
    if (!l.there || !v.there || !load.there || !material.there || !out.there)
        return nullptr;
    if ((l.count() != out.count() || v.count() != out.count() || load.count() != out.count())
            && !differ("accelerations"))
        return nullptr;
    with_system(material.numbers(), [&](const auto &system) {
        for (int i = 0; i < out.count(); i++)
            out.numbers()[i] = system.acceleration(
                l.numbers()[i], v.numbers()[i], system.drag, under(load.numbers()[i]));
    });
    Py_RETURN_NONE;
}
// -- two-step plans ---------------------------------------------------------------------------------

// turning_point(stretch, rate, direction, load, move, material, rtol)
PyObject *turning_point_of(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double number[5], rtol;
    if (refused("turning_point", 7, count) || !read(arguments, 5, number)
            || !read(arguments + 6, 1, &rtol))
        return nullptr;
    const Buffer material(arguments[5]);
    if (!material.there)
        return nullptr;
    const double *m = material.numbers();
    const Event event = with_system(m, [&](const auto &system) {
        return turning_point(
            system, number[0], number[1], number[2], number[3], number[4], m[zeta_at], rtol);
    });
    return Py_BuildValue("idddd", int(event.status), event.time, event.stretch, event.by_load,
        event.time_by_load);
}
// two_step(start, rate, target, material, least, most, rtol, hold)
PyObject *two_step_of(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double move[3], wanted[4];
    if (refused("two_step", 8, count) || !read(arguments, 3, move) || !read(arguments + 4, 4, wanted))
        return nullptr;
    const Buffer material(arguments[3]);
    if (!material.there)
        return nullptr;
    const Plan plan = with_system(material.numbers(), [&](const auto &system) {
        Planner<std::decay_t<decltype(system)>> planner;
        return planner(system, material.numbers(), {move[0], move[1], move[2]},
            {wanted[0], wanted[1], wanted[2], wanted[3]});
    });
    return Py_BuildValue("idddi", plan.status, plan.beta_p, plan.tau_p, plan.beta_1, plan.passes);
}
// One source, two instruction sets: all that a step does is inlined into what names its own.
__attribute__((target("avx2"), flatten)) void plan_wide(const Rows &rows)
{
    plan_lanes<four, Gent>(rows);
}
__attribute__((flatten)) void plan_narrow(const Rows &rows) { plan_lanes<two, Gent>(rows); }
// two_step_batch(start, rate, target, materials, stride, least, most, rtol, hold, wide, status,
// beta_p, tau_p, beta_1)
PyObject *two_step_batch(PyObject *, PyObject *arguments)
{
    PyObject *in[4], *out[4];
    int wide;
    Rows rows{};
    if (!PyArg_ParseTuple(arguments, "OOOOiddddpOOOO", &in[0], &in[1], &in[2], &in[3], &rows.stride,
            &rows.wanted.least, &rows.wanted.most, &rows.wanted.rtol, &rows.wanted.hold, &wide,
            &out[0], &out[1], &out[2], &out[3]))
        return nullptr;
    const Buffer start(in[0]), rate(in[1]), target(in[2]), materials(in[3]),
        status(out[0], true, whole),
        beta_p(out[1], true), tau_p(out[2], true), beta_1(out[3], true);
    if (PyErr_Occurred())
        return nullptr;
    rows.count = start.count();
    for (const Buffer *x : {&rate, &target, &status, &beta_p, &tau_p, &beta_1})
        if (x->count() != rows.count && !differ("two_step_batch"))
            return nullptr;
    if (rows.count == 0)
        Py_RETURN_NONE;
    rows.start = start.numbers(), rows.rate = rate.numbers(), rows.target = target.numbers();
    rows.materials = materials.numbers();
    rows.status = static_cast<int64_t *>(status.view.buf);
    rows.beta_p = beta_p.numbers(), rows.tau_p = tau_p.numbers(), rows.beta_1 = beta_1.numbers();
    Py_BEGIN_ALLOW_THREADS;
    if (int(rows.materials[kind_at]) > neo_hookean)
        plan_rows<Any>(rows);
    else if (wide && __builtin_cpu_supports("avx2"))
        plan_wide(rows);
    else
        plan_narrow(rows);
    Py_END_ALLOW_THREADS;
    Py_RETURN_NONE;
}

// -- motion over time -------------------------------------------------------------------------------

// follow(first, last, wanted, state, drive, material, branches, durations, rtol, status): how many do
// not get through
PyObject *follow(PyObject *, Arguments arguments, Py_ssize_t count)
{
    if (refused("follow", 10, count))
        return nullptr;
    Plant plant{};
    plant.first = int(PyLong_AsLong(arguments[0])), plant.last = int(PyLong_AsLong(arguments[1]));
    if (!read(arguments + 8, 1, &plant.rtol))
        return nullptr;
    const Buffer wanted(arguments[2], false, truth), state(arguments[3], true), drive(arguments[4], true),
        material(arguments[5]), branches(arguments[6], true), durations(arguments[7]),
        status(arguments[9], true, whole);
    if (PyErr_Occurred())
        return nullptr;
    const int rows = durations.count();
    if ((state.count() != 3 * rows || drive.count() != 4 * rows || status.count() != rows
            || wanted.view.len != rows || plant.first < 0 || plant.last > rows
            || (branches.count() && branches.count() != 3 * most_branches * rows))
            && !differ("follow"))
        return nullptr;
    plant.wanted = static_cast<const bool *>(wanted.view.buf);
    plant.state = state.numbers(), plant.drive = drive.numbers();
    plant.material = material.numbers(), plant.stride = rows ? material.count() / rows : 0;
    plant.branches = branches.count() ? branches.numbers() : nullptr;
    plant.durations = durations.numbers();
    plant.status = static_cast<int64_t *>(status.view.buf);
    long failed = 0;
    for (int i = plant.first; i < plant.last; i++) {
        if (!plant.wanted[i])
            continue;
        int creeping = 0;
        if (plant.branches)
            while (creeping < most_branches
                    && plant.branches[3 * (most_branches * i + creeping) + speed_at] > 0)
                creeping++;
        const bool done = with_system(plant.material + int64_t(plant.stride) * i,
            [&](const auto &system) {
                return with_branches(creeping, [&](auto n) {
                    return advance_row<n()>(plant, i, system);
                });
            });
        plant.status[i] = done ? turned : stuck;
        failed += !done;
    }
    return PyLong_FromLong(failed);
}
// sample(stretch, rate, field, switches, loads, slopes, lag, times, material, branches, rtol, out):
// whether the motion was followed to its end
PyObject *sample_of(PyObject *, Arguments arguments, Py_ssize_t count)
{
    if (refused("sample", 12, count))
        return nullptr;
    Course course{};
    double start[3];
    if (!read(arguments, 3, start) || !read(arguments + 6, 1, &course.lag)
            || !read(arguments + 10, 1, &course.rtol))
        return nullptr;
    const Buffer switches(arguments[3]), loads(arguments[4]), slopes(arguments[5]),
        times(arguments[7]), material(arguments[8]), branches(arguments[9]), out(arguments[11], true);
    if (PyErr_Occurred())
        return nullptr;
    course.branch_count = branches.count() / 3;
    if ((loads.count() != switches.count() || slopes.count() != switches.count()
            || out.count() != (3 + course.branch_count) * times.count() || !switches.count()
            || course.branch_count > most_branches) && !differ("sample"))
        return nullptr;
    course.pieces = switches.count(), course.count = times.count();
    course.switches = switches.numbers(), course.loads = loads.numbers();
    course.slopes = slopes.numbers(), course.times = times.numbers();
    course.stretch = start[0], course.rate = start[1], course.field = start[2];
    course.zeta = material.numbers()[zeta_at];
    course.branches = branches.numbers(), course.out = out.numbers();
    bool done;
    Py_BEGIN_ALLOW_THREADS;
    done = with_system(material.numbers(), [&](const auto &system) {
        return with_branches(course.branch_count, [&](auto n) { return sample<n()>(system, course); });
    });
    Py_END_ALLOW_THREADS;
    return PyBool_FromLong(done);
}

// -- levels ---------------------------------------------------------------------------------------

// solve(times, loads, d_times, d_loads, stretch, rate, field, load, target, slew, lag, material,
// branches, followed): whether it is solved, and the duration
PyObject *solve(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double number[7];
    if (refused("solve", 14, count) || !read(arguments + 4, 7, number))
        return nullptr;
    const Buffer times(arguments[0], true), loads(arguments[1], true), d_times(arguments[2]),
        d_loads(arguments[3]), material(arguments[11]), branches(arguments[12]),
        followed(arguments[13]);
    if (PyErr_Occurred())
        return nullptr;
    const int levels = times.count(), unknowns = levels ? d_times.count() / levels : 0;
    const int creeping = followed.count();
    if ((!levels || loads.count() != levels || d_times.count() != unknowns * levels
            || d_loads.count() != unknowns * levels || branches.count() != 2 * creeping
            || levels > most_levels || unknowns > most_unknowns || creeping > most_branches)
            && !differ("solve"))
        return nullptr;
    const Shot shot{levels, unknowns, times.numbers(), loads.numbers(), d_times.numbers(),
        d_loads.numbers(), number[0], number[1], number[2], number[3], number[4], number[5],
        number[6], branches.numbers(), creeping, followed.numbers()};
    double lasts = 0;
    const bool solved = with_system(material.numbers(), [&](const auto &system) {
        using System = std::decay_t<decltype(system)>;
        return with_branches(creeping, [&](auto n) {
            if (unknowns <= 2) {
                Shooting<System, n(), 2> shooting{system, shot};
                return shooting.solve(material.numbers(), lasts);
            }
            Shooting<System, n(), most_unknowns> shooting{system, shot};
            return shooting.solve(material.numbers(), lasts);
        });
    });
    return Py_BuildValue("Nd", PyBool_FromLong(solved), lasts);
}
// staircase(held, branches, stretch, material, lag, period, end, ripple, out): the number of levels
// and a bound of their vibration
PyObject *staircase(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double stretch, number[4];
    if (refused("staircase", 9, count) || !read(arguments + 2, 1, &stretch)
            || !read(arguments + 4, 4, number))
        return nullptr;
    const Buffer held(arguments[0]), branches(arguments[1]), material(arguments[3]),
        out(arguments[8], true);
    if (PyErr_Occurred())
        return nullptr;
    Tail tail{};
    tail.count = held.count();
    if ((branches.count() != 2 * tail.count || tail.count > most_branches) && !differ("staircase"))
        return nullptr;
    tail.held = held.numbers(), tail.branches = branches.numbers();
    tail.lag = number[0], tail.period = number[1], tail.until = number[2];
    tail.out = out.numbers(), tail.room = out.count() / columns;
    double most = 0;
    const int found = with_system(material.numbers(), [&](const auto &system) {
        tail.set_up(system, stretch);
        return tail.staircase(number[3], most);
    });
    return Py_BuildValue("id", found, most);
}

// -- recordings --------------------------------------------------------------------------------------

using Four = Dual<double, 4>;
using Eight = Dual<double, 8>;
template <class S, class System, int NB> bool respond_as(const Recorded &of, int from)
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
template <class S, int NB> bool respond_part(const Recorded &of, int from)
{
    if (int(of.material[kind_at]) > neo_hookean)
        return of.by_constants() ? respond_as<Eight, AnyOf<Eight>, NB>(of, from)
                                 : respond_as<S, Any, NB>(of, from);
    if constexpr (count_of<S> > 0)
        if (__builtin_cpu_supports("avx2"))
            return respond_wide<S, NB>(of, from);
    return respond_as<S, Block<S, Gent>, NB>(of, from);
}
template <int NB> bool respond_all(const Recorded &of)
{
    if (of.wanted_count == 0)
        return respond_part<double, NB>(of, 0);
    const bool any = int(of.material[kind_at]) > neo_hookean && of.by_constants();
    for (int from = 0; from < of.wanted_count; from += 8)
        if (!(of.wanted_count - from > 4 || any ? respond_part<Eight, NB>(of, from)
                                                : respond_part<Four, NB>(of, from)))
            return false;
    return true;
}
// respond(theta, material, branches, wanted, start, begins, levels, ramps, field, field_lag, times,
// rtol, stretch, rate, jacobian, by_rate, behind, behind_last): whether the motion was followed to
// its end
PyObject *respond(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double number[3];
    if (refused("respond", 18, count) || !read(arguments + 8, 2, number)
            || !read(arguments + 11, 1, number + 2))
        return nullptr;
    Recorded of{};
    of.branches = int(PyLong_AsLong(arguments[2]));
    const Buffer theta(arguments[0]), material(arguments[1]), wanted(arguments[3], false, whole),
        start(arguments[4]), begins(arguments[5]), levels(arguments[6]), ramps(arguments[7]),
        times(arguments[10]), stretch(arguments[12], true), rate(arguments[13], true),
        jacobian(arguments[14], true), by_rate(arguments[15], true), behind(arguments[16]),
        behind_last(arguments[17], true);
    if (PyErr_Occurred())
        return nullptr;
    of.wanted_count = wanted.count(), of.count = times.count(), of.pieces = begins.count();
    const Py_ssize_t cells = Py_ssize_t(of.count) * of.wanted_count;
    if ((theta.count() != first_branch + 2 * of.branches || start.count() != of.wanted_count
            || levels.count() != of.pieces || ramps.count() != of.pieces || !of.pieces
            || stretch.count() != of.count || rate.count() != of.count || jacobian.count() != cells
            || (by_rate.count() && by_rate.count() != cells)
            || (behind.count() && behind.count() != of.branches)
            || (behind_last.count() && behind_last.count() != of.branches)
            || of.branches < 0 || of.branches > most_branches) && !differ("respond"))
        return nullptr;
    of.theta = theta.numbers(), of.material = material.numbers();
    of.wanted = static_cast<const int64_t *>(wanted.view.buf), of.start = start.numbers();
    of.begins = begins.numbers(), of.levels = levels.numbers(), of.ramps = ramps.numbers();
    of.field = number[0], of.field_lag = number[1], of.rtol = number[2];
    of.times = times.numbers(), of.stretch = stretch.numbers(), of.rate = rate.numbers();
    of.jacobian = jacobian.numbers(), of.by_rate = by_rate.count() ? by_rate.numbers() : nullptr;
    of.behind = behind.count() ? behind.numbers() : nullptr;
    of.behind_last = behind_last.count() ? behind_last.numbers() : nullptr;
    bool done;
    Py_BEGIN_ALLOW_THREADS;
    done = with_branches(of.branches, [&](auto n) { return respond_all<n()>(of); });
    Py_END_ALLOW_THREADS;
    return PyBool_FromLong(done);
}

// rest(theta, material, level, wanted, slopes): the stretch at which a level holds the actuator, no
// number if there is none; its derivatives by what is wanted are written
PyObject *rest(PyObject *, Arguments arguments, Py_ssize_t count)
{
    double level;
    if (refused("rest", 5, count) || !read(arguments + 2, 1, &level))
        return nullptr;
    const Buffer theta(arguments[0]), material(arguments[1]), wanted(arguments[3], false, whole),
        slopes(arguments[4], true);
    if (PyErr_Occurred())
        return nullptr;
    if ((theta.count() < first_branch || wanted.count() != slopes.count()) && !differ("rest"))
        return nullptr;
    Recorded of{};
    of.theta = theta.numbers(), of.material = material.numbers(), of.wanted_count = wanted.count();
    of.wanted = static_cast<const int64_t *>(wanted.view.buf);
    const double pull = of.theta[drive_of] * level + of.theta[force_of];
    const double l = quantity(equilibrium_q, pull / of.theta[stiffness_of], of.material);
    for (int from = 0; from < of.wanted_count; from += 8)
        if (int(of.material[kind_at]) > neo_hookean)
            Response<Eight, AnyOf<Eight>, 0>(of, from).hold(l, level, slopes.numbers());
        else
            Response<Eight, Block<Eight, Gent>, 0>(of, from).hold(l, level, slopes.numbers());
    const bool held = hmsa::finite(quantity(stiffness_q, l, of.material));
    return PyFloat_FromDouble(held ? l : __builtin_nan(""));
}

template <class F> PyCFunction fast(F f) { return (PyCFunction)(void (*)())f; }
PyMethodDef methods[] = {
    {"elastic_force", fast(quantity_of<force_q>), METH_FASTCALL, nullptr},
    {"elastic_stiffness", fast(quantity_of<stiffness_q>), METH_FASTCALL, nullptr},
    {"elastic_energy", fast(quantity_of<energy_q>), METH_FASTCALL, nullptr},
    {"mass", fast(quantity_of<mass_q>), METH_FASTCALL, nullptr},
    {"natural_frequency", fast(quantity_of<frequency_q>), METH_FASTCALL, nullptr},
    {"critical_zeta", fast(quantity_of<critical_zeta_q>), METH_FASTCALL, nullptr},
    {"equilibrium_stretch", fast(quantity_of<equilibrium_q>), METH_FASTCALL, nullptr},
    {"damping", fast(quantity_of<damping_q>), METH_FASTCALL, nullptr},
    {"evaluate", fast(evaluate), METH_FASTCALL, nullptr},
    {"accelerations", fast(accelerations), METH_FASTCALL, nullptr},
    {"turning_point", fast(turning_point_of), METH_FASTCALL, nullptr},
    {"two_step", fast(two_step_of), METH_FASTCALL, nullptr},
    {"two_step_batch", two_step_batch, METH_VARARGS, nullptr},
    {"follow", fast(follow), METH_FASTCALL, nullptr},
    {"sample", fast(sample_of), METH_FASTCALL, nullptr},
    {"solve", fast(solve), METH_FASTCALL, nullptr},
    {"staircase", fast(staircase), METH_FASTCALL, nullptr},
    {"respond", fast(respond), METH_FASTCALL, nullptr},
    {"rest", fast(rest), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr}};
PyModuleDef module = {PyModuleDef_HEAD_INIT, "_motion", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};
}  // namespace

PyMODINIT_FUNC PyInit__motion() { return PyModule_Create(&module); }
