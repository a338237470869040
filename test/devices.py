"""Devices as tests command and advance them, in ms after their start."""

MS = 1_000_000
START = 1000 * MS


def advance(device, *times):
    for time in times:
        device.advance(START + time * MS)


def command(device, *levels, until=None):
    """Give levels (ms, T) to the only joint, and perhaps advance."""
    for stamp, level in levels:
        device.receive(0, START + stamp * MS, level)
    if until is not None:
        advance(device, until)
