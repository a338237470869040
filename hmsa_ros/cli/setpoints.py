"""Setpoints as words on the command line."""

import argparse

from hmsa_ros.errors import BadInputError


def setpoint(text: str) -> tuple[float, float]:
    """
    Read ``STRETCH:SPAN``.

    Parameters
    ----------
    text : str
        For example ``'1.10:10'``.

    Returns
    -------
    tuple of float
        Stretch and span.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not two numbers in range.

    """
    # Not imported above: Numba comes along, which ``hmsa --help`` has no use for.
    from hmsa_ros.core.sequence import Setpoint

    stretch, colon, span = text.partition(':')
    try:
        if not colon:
            raise ValueError(text)
        result = Setpoint(float(stretch), float(span))
        if result.span == float('inf'):
            raise BadInputError('span is inf: expected a finite number')
    except BadInputError as error:
        raise argparse.ArgumentTypeError(f'{text!r}: {error}') from error
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r}: expected STRETCH:SPAN, two numbers such as 1.10:10') from None
    return result.stretch, result.span
