"""What a parameter file plans with, without a node."""

from dataclasses import replace
from pathlib import Path

from hmsa_ros.interfaces.actuator import model_from
from hmsa_ros.interfaces.parameters import CREEP_TOLERANCE, PLANNED, VISCOELASTIC
from hmsa_ros.interfaces.topics import PLANNER
from hmsa_ros.model.delivery import IDEAL
from hmsa_ros.planning.timeline import Model
from hmsa_ros.recordings.parameters import read_parameter_file, values_of


def model_of(path: Path) -> Model:
    """Return what the planner of a file plans with, or raise `BadInputError`."""
    return model_from(values_of(
        read_parameter_file(path), PLANNER,
        # Nobody has to send these levels: unless the file says how fine, they are very fine.
        (*PLANNED, *VISCOELASTIC, replace(CREEP_TOLERANCE, default=IDEAL.ripple))))
