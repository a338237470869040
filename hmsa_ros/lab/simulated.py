"""Planner and simulated plant for one run, in slow motion where real time would be too fast."""

from collections.abc import Mapping
import math

from hmsa_ros.interfaces.actuator import actuator_from
from hmsa_ros.interfaces.parameters import BLOCK
from hmsa_ros.interfaces.topics import PLANNER, PLANT
from hmsa_ros.lab.processes import NodeProcess
from hmsa_ros.model.equations import natural_frequency
from hmsa_ros.recordings.parameters import values_of

# Samples a period of the actuator, and samples that planner, plant and recorder pass on together
# in a second of ours.
_SAMPLES_A_PERIOD = 50.0
_SAMPLES_A_SECOND = 1000.0
# How far ahead in our time commands are sent: a busy machine may take that long. Feedback is to
# correct a move before the next one.
_LEAD_SECONDS, _CORRECTED_SECONDS = 2.0, 0.5


def simulated_nodes(
        settings: Mapping[str, object], params_file: str,
        namespace: str) -> tuple[NodeProcess, NodeProcess]:
    """Return a paused plant that leads simulated time, and a planner that follows it."""
    # What the parameter file sets goes before what is chosen here.
    block = actuator_from(values_of(settings, PLANT, BLOCK))
    period = 2.0 * math.pi * block.time_unit / float(
        natural_frequency(block.rest, block.nondimensional))
    rate = _number(settings, f'{PLANT}.publish_rate', max(1000.0, _SAMPLES_A_PERIOD / period))
    factor = _number(
        settings, f'{PLANT}.real_time_factor', min(1.0, _SAMPLES_A_SECOND / rate))
    feedback = settings.get(f'{PLANNER}.feedback', 'off')
    ahead = _LEAD_SECONDS if feedback in ('off', False) else _CORRECTED_SECONDS
    lead = _number(settings, f'{PLANNER}.lead_time', ahead * (factor or 1.0))
    return (
        NodeProcess(PLANT, {
            'publish_clock': True, 'use_sim_time': False, 'start_paused': True,
            'publish_rate': rate, 'real_time_factor': factor}, namespace, params_file),
        NodeProcess(PLANNER, {
            'use_sim_time': True, 'lead_time': lead,
            'feedback': feedback}, namespace, params_file))


def _number(settings: Mapping[str, object], name: str, default: float) -> float:
    """Return what the file sets, as the node reads a number."""
    value = settings.get(name)
    return float(value) if isinstance(value, (int, float)) else default
