/*
Ends this process after some running time, even if Python is blocked.

A thread counts ticks. It does not count while the process is stopped, unlike a system timer.
*/
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { TICK_MS = 10, WRITE_MS = 50, LONGEST = 500, DEADLINES = 2 };

/* Ticks left, 0 for no deadline; exit status; and a line for the error output. */
static struct {
    atomic_long left;
    atomic_int status;
    char text[LONGEST];
    size_t length;
} deadlines[DEADLINES];

static int counting = 0;

/* A blocked reader must not delay the end: the line is only written if there is room for it. */
static void end(int number) {
    struct pollfd error_output = {STDERR_FILENO, POLLOUT, 0};
    if (deadlines[number].length && poll(&error_output, 1, WRITE_MS) > 0) {
        ssize_t written = write(STDERR_FILENO, deadlines[number].text, deadlines[number].length);
        (void)written;
    }
    _exit(atomic_load(&deadlines[number].status));
}

static void *count(void *unused) {
    const struct timespec tick = {0, TICK_MS * 1000000L};
    for (;;) {
        nanosleep(&tick, NULL);
        for (int i = 0; i < DEADLINES; ++i) {
            long left = atomic_load(&deadlines[i].left);
            if (left > 0 && atomic_compare_exchange_strong(&deadlines[i].left, &left, left - 1)
                && left == 1) {
                end(i);
            }
        }
    }
    return unused;
}

static void forget(void) {
    counting = 0;
    for (int i = 0; i < DEADLINES; ++i) {
        atomic_store(&deadlines[i].left, 0);
    }
}

/* Signals are handled by the threads of Python. */
static int start(void) {
    sigset_t all, before;
    pthread_t thread;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    int error = pthread_create(&thread, NULL, count, NULL);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    if (!error) {
        pthread_detach(thread);
        counting = 1;
    }
    return error;
}

static PyObject *set(PyObject *self, PyObject *arguments) {
    int number, status;
    double seconds;
    if (!PyArg_ParseTuple(arguments, "idi", &number, &seconds, &status)) {
        return NULL;
    }
    if (number < 0 || number >= DEADLINES || !(seconds >= 0.0 && seconds < 1e6)) {
        PyErr_SetString(PyExc_ValueError, "expected a deadline of 0 or 1, and 0 to 1e6 s");
        return NULL;
    }
    if (!counting && (errno = start()) != 0) {
        return PyErr_SetFromErrno(PyExc_OSError);
    }
    atomic_store(&deadlines[number].status, status);
    /* The tick under way does not count. */
    atomic_store(&deadlines[number].left, seconds > 0.0 ? (long)(1e3 * seconds / TICK_MS) + 2 : 0);
    Py_RETURN_NONE;
}

static PyObject *say(PyObject *self, PyObject *arguments) {
    int number;
    const char *text;
    Py_ssize_t length;
    if (!PyArg_ParseTuple(arguments, "iy#", &number, &text, &length)) {
        return NULL;
    }
    if (number < 0 || number >= DEADLINES || length > LONGEST) {
        PyErr_SetString(PyExc_ValueError, "expected a deadline of 0 or 1, and at most 500 bytes");
        return NULL;
    }
    memcpy(deadlines[number].text, text, (size_t)length);
    deadlines[number].length = (size_t)length;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"set", set, METH_VARARGS, "set(number, seconds, status): End after some seconds; 0 for never."},
    {"say", say, METH_VARARGS, "say(number, text): Set the line to write at the deadline."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_deadline", "Ends this process after some running time.", -1, methods,
    NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__deadline(void) {
    PyObject *made = PyModule_Create(&module);
    if (made && PyModule_AddIntConstant(made, "LONGEST", LONGEST)) {
        Py_CLEAR(made);
    }
    pthread_atfork(NULL, NULL, forget);
    return made;
}
