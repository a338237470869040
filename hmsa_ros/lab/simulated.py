"""Planner and simulated plant for one run, in one process and in simulated time."""

from collections.abc import Mapping
import math

from hmsa_ros.interfaces.actuator import actuator_from
from hmsa_ros.interfaces.parameters import BLOCK
from hmsa_ros.interfaces.topics import PLANNER, PLANT
from hmsa_ros.lab.processes import NodeProcess
from hmsa_ros.model.equations import natural_frequency
from hmsa_ros.recordings.parameters import values_of

# Samples a period of the actuator, and samples that plant and recorder pass on in a second of
# ours: where there are more of them, simulated time runs slower.
_SAMPLES_A_PERIOD = 25.0
_SAMPLES_A_SECOND = 4000.0


def simulated_nodes(
        settings: Mapping[str, object], params_file: str,
        namespace: str) -> tuple[NodeProcess]:
    """
    Return a planner and a paused plant that leads its time.

    They are one process: time waits for the planner, however busy the machine is.
    """
    # What the parameter file sets goes before what is chosen here.
    block = actuator_from(values_of(settings, PLANT, BLOCK))
    period = 2.0 * math.pi * block.time_unit / float(
        natural_frequency(block.rest, block.nondimensional))
    rate = _number(settings, 'publish_rate', max(1000.0, _SAMPLES_A_PERIOD / period))
    factor = _number(settings, 'real_time_factor', min(1.0, _SAMPLES_A_SECOND / rate))
    return NodeProcess('controller', {
        f'{PLANT}:publish_clock': True, f'{PLANT}:use_sim_time': False,
        f'{PLANT}:start_paused': True, f'{PLANT}:publish_rate': rate,
        f'{PLANT}:publish_scalars': 'never',
        f'{PLANT}:real_time_factor': factor, f'{PLANNER}:use_sim_time': True,
        f'{PLANNER}:feedback': settings.get(f'{PLANNER}.feedback', 'off')},
        namespace, params_file),


def _number(settings: Mapping[str, object], name: str, default: float) -> float:
    """Return what the file sets for the plant, as the node reads a number."""
    value = settings.get(f'{PLANT}.{name}')
    return float(value) if isinstance(value, (int, float)) else default
