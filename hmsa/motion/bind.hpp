// Binds functions over numbers and buffers to Python: `bound` converts arguments and results.
#pragma once
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <optional>
#include <tuple>
#include <vector>
#ifdef __SSE2__
#include <xmmintrin.h>
#endif
#include "hmsa/system.hpp"

namespace hmsa {
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
template <> struct Argument<int64_t> {
    int64_t got;
    bool read(PyObject *from)
    {
        got = PyLong_AsLongLong(from);
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
inline bool fit(bool is)
{
    if (!is)
        PyErr_SetString(PyExc_ValueError, "expected arrays that fit each other");
    return is;
}

inline PyObject *made(double x) { return PyFloat_FromDouble(x); }
inline PyObject *made(int x) { return PyLong_FromLong(x); }
inline PyObject *made(bool x) { return PyBool_FromLong(x); }
struct Nothing {};
inline PyObject *made(Nothing) { Py_RETURN_NONE; }
template <class... T> PyObject *made(const std::vector<std::tuple<T...>> &all);
template <class... T> PyObject *made(const std::tuple<T...> &all)
{
    PyObject *out = PyTuple_New(sizeof...(T));
    int i = 0;
    std::apply([&](const T &...x) { (PyTuple_SET_ITEM(out, i++, made(x)), ...); }, all);
    return out;
}
template <class... T> PyObject *made(const std::vector<std::tuple<T...>> &all)
{
    PyObject *out = PyTuple_New(Py_ssize_t(all.size()));
    for (size_t i = 0; i < all.size(); i++)
        PyTuple_SET_ITEM(out, Py_ssize_t(i), made(all[i]));
    return out;
}
template <class T> PyObject *made(const std::optional<T> &x) { return x ? made(*x) : made(Nothing{}); }
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
template <auto f> PyMethodDef method(const char *name)
{
    return {name, (PyCFunction)(void (*)())bound<f>, METH_FASTCALL, nullptr};
}
}  // namespace hmsa
