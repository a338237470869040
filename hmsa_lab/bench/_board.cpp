// The firmware of hmsa_board/ on the host; its state is a bytearray.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <new>

#include "hmsa_board/board.hpp"

namespace {

using hmsa::Board;

// Converts a bytearray argument to the board in it; an exception if it is invalid.
int board_in(PyObject *state, void *board) {
    if (!PyByteArray_Check(state) || PyByteArray_GET_SIZE(state) != sizeof(Board)) {
        PyErr_SetString(PyExc_TypeError, "expected what make has returned");
        return 0;
    }
    *static_cast<Board **>(board) = reinterpret_cast<Board *>(PyByteArray_AS_STRING(state));
    return 1;
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
    Board *board;
    const char *text;
    Py_ssize_t length;
    long long now;
    if (!PyArg_ParseTuple(arguments, "O&y#L", board_in, &board, &text, &length, &now)) {
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
    Board *board;
    long long now;
    if (!PyArg_ParseTuple(arguments, "O&L", board_in, &board, &now)) {
        return nullptr;
    }
    return PyLong_FromLong(board->advance(now));
}

PyObject *sample(PyObject *, PyObject *arguments) {
    Board *board;
    long long time;
    int reading;
    if (!PyArg_ParseTuple(arguments, "O&Li", board_in, &board, &time, &reading)) {
        return nullptr;
    }
    board->sample(time, reading);
    Py_RETURN_NONE;
}

PyObject *warm(PyObject *, PyObject *arguments) {
    Board *board;
    int temperature;
    if (!PyArg_ParseTuple(arguments, "O&i", board_in, &board, &temperature)) {
        return nullptr;
    }
    board->warm(temperature);
    Py_RETURN_NONE;
}

PyObject *due(PyObject *, PyObject *state) {
    Board *board;
    return board_in(state, &board) ? PyLong_FromLongLong(board->due()) : nullptr;
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
