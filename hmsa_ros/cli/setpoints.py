"""Setpoints as words on the command line."""

import argparse
import math

from hmsa_ros.core.setpoint import Setpoint
from hmsa_ros.errors import BadInputError


def setpoint(text: str) -> tuple[float, float]:
    """
    Read stretch and hold time from a text as ``'1.10:10'``.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not two numbers in range.

    """
    stretches, span = setpoint_of_joints(text)
    if len(stretches) > 1:
        raise _no_setpoint(text)
    return stretches[0], span


def setpoint_of_joints(text: str) -> tuple[tuple[float, ...], float]:
    """
    Read one stretch or one a joint, and the hold time, from ``'1.10:10'`` or ``'1.10,1.20:10'``.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not numbers in range.

    """
    stretches, colon, span = text.partition(':')
    try:
        if not colon:
            raise ValueError(text)
        found = [Setpoint(float(stretch), float(span)) for stretch in stretches.split(',')]
        if math.isinf(found[0].span):
            raise BadInputError('span is inf: expected a finite number')
    except BadInputError as error:
        raise argparse.ArgumentTypeError(f'{text!r}: {error}') from error
    except ValueError:
        raise _no_setpoint(text) from None
    return tuple(x.stretch for x in found), found[0].span


def _no_setpoint(text: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(
        f'{text!r}: expected STRETCH:SPAN, two numbers such as 1.10:10')
