"""Table: measured levels that hold a block at rest, instead of a formula."""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError
from hmsa.model.laws.record import Constant, Elastic, Law, positive_modulus, TABLE
from hmsa.model.units import MU_0

_FILE, _STRETCH, _FLUX = 'law.file', 'law.stretch', 'law.flux_density'


def _completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the points from the file, unless the parameters contain them."""
    if values[_STRETCH] or values[_FLUX]:
        return {}
    if not values[_FILE]:
        raise BadInputError(
            f'law {LAW.name} has neither {_FILE} nor points: expected the path of a CSV with the '
            'columns stretch and flux_density (T)')
    from hmsa.model.laws import curve  # imports NumPy, which not all users of laws need

    return dict(zip((_STRETCH, _FLUX), curve.points_in(values[_FILE]), strict=True))


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    values = {**values, **_completed(values)}
    from hmsa.model.laws import curve  # after the check: a planner may check this in its loop

    stretch, flux = tuple(values[_STRETCH]), tuple(values[_FLUX])
    found = curve.fitted(stretch, flux)
    # psi'' is 3 at rest, in units of G, for all models.
    unit = found.slope / 3.0
    remanence = float(values['actuator.remanence'])
    modulus = positive_modulus(
        LAW.name, unit * remanence / MU_0, 'Br dB/dl/(3 mu0) at stretch 1',
        (f'{found.slope:g} T per unit of stretch', f'Br {remanence:g} T'))
    return modulus, Elastic(
        LAW.name, TABLE, found.packed(unit),
        ((_STRETCH, stretch), (_FLUX, tuple(x / unit for x in flux))), (stretch[0], stretch[-1]))


LAW = Law(
    'table', 'Br/mu0 times the integral of the level that holds the stretch', 'a measurement',
    (Constant(_FILE, 'CSV with the columns stretch and flux_density (T), held at rest; a '
              'relative path starts in the working directory of the process', '', str, fixed=True),
     Constant(_STRETCH, 'stretches of its points, from the file unless given', '', list,
              0.1, 10.0, fixed=True),
     Constant(_FLUX, 'levels that hold them, from the file unless given', 'T', list, -5.0, 5.0,
              fixed=True)),
    _scaled, completed=_completed)
