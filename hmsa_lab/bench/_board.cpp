// The firmware of hmsa_board/ on the host; its state is a bytearray.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <new>

#include "hmsa_board/board.hpp"

namespace {

using hmsa::Board;

// Return the board in a bytearray argument; nullptr with an exception if it is invalid.
Board *board_in(PyObject *state) {
    if (!PyByteArray_Check(state) || PyByteArray_GET_SIZE(state) != sizeof(Board)) {
        PyErr_SetString(PyExc_TypeError, "expected what make has returned");
        return nullptr;
    }
    return reinterpret_cast<Board *>(PyByteArray_AS_STRING(state));
}

PyObject *make(PyObject *, PyObject *arguments) {
    int limit, resolution;
    if (!PyArg_ParseTuple(arguments, "ii", &limit, &resolution)) {
        return nullptr;
    }
    PyObject *state = PyByteArray_FromStringAndSize(nullptr, sizeof(Board));
    if (state) {
        new (PyByteArray_AS_STRING(state)) Board(limit, resolution);
    }
    return state;
}

PyObject *receive(PyObject *, PyObject *arguments) {
    PyObject *state;
    const char *text;
    Py_ssize_t length;
    long long now;
    if (!PyArg_ParseTuple(arguments, "Oy#L", &state, &text, &length, &now)) {
        return nullptr;
    }
    Board *board = board_in(state);
    if (!board) {
        return nullptr;
    }
    char answer[4 * hmsa::LONGEST_ANSWER];
    Py_ssize_t filled = 0;
    for (Py_ssize_t i = 0; i < length; ++i) {
        board->receive(text[i], now);
        while (filled < static_cast<Py_ssize_t>(sizeof answer) && board->send(answer[filled])) {
            ++filled;
        }
    }
    return PyBytes_FromStringAndSize(answer, filled);
}

PyObject *advance(PyObject *, PyObject *arguments) {
    PyObject *state;
    long long now;
    if (!PyArg_ParseTuple(arguments, "OL", &state, &now)) {
        return nullptr;
    }
    Board *board = board_in(state);
    return board ? PyLong_FromLong(board->advance(now)) : nullptr;
}

PyObject *sample(PyObject *, PyObject *arguments) {
    PyObject *state;
    long long time;
    int reading;
    if (!PyArg_ParseTuple(arguments, "OLi", &state, &time, &reading)) {
        return nullptr;
    }
    Board *board = board_in(state);
    if (!board) {
        return nullptr;
    }
    board->sample(time, reading);
    Py_RETURN_NONE;
}

PyObject *warm(PyObject *, PyObject *arguments) {
    PyObject *state;
    int temperature;
    if (!PyArg_ParseTuple(arguments, "Oi", &state, &temperature)) {
        return nullptr;
    }
    Board *board = board_in(state);
    if (!board) {
        return nullptr;
    }
    board->warm(temperature);
    Py_RETURN_NONE;
}

PyObject *due(PyObject *, PyObject *state) {
    Board *board = board_in(state);
    return board ? PyLong_FromLongLong(board->due()) : nullptr;
}

PyMethodDef methods[] = {
    {"make", make, METH_VARARGS, "make(limit, resolution): Return the state of a booted board."},
    {"receive", receive, METH_VARARGS, "receive(state, bytes, now): Return its immediate answer."},
    {"advance", advance, METH_VARARGS, "advance(state, now): Return its output level."},
    {"sample", sample, METH_VARARGS, "sample(state, time, reading): Store a sample."},
    {"warm", warm, METH_VARARGS, "warm(state, temperature): Set the coil temperature."},
    {"due", due, METH_O, "due(state): Return the time of the next advance, or -1."},
    {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_board", "The firmware of the serial board on the host.", -1, methods,
    nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__board() { return PyModule_Create(&module); }
