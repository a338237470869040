"""Temperature over ROS: who subscribes and publishes, and what is recorded of it."""

from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import Temperature
from std_msgs.msg import Float64

from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import texts
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.thermal import Thermal
from hmsa.runs.bags import read_run
from hmsa.runs.verify import verify_run
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode

pytestmark = pytest.mark.ros

COEFFICIENTS = ('-p', 'thermal.shear_modulus:=0.003', '-p', 'thermal.remanence:=-0.001')
TOPIC = f'/{topics.TEMPERATURE.name}'


def test_planner_without_coefficients_does_not_subscribe(serve, ros):
    serve(PlannerNode)
    ros.spin_until(lambda: ros.node.count_publishers('planner/status'), 'the planner')
    assert ros.node.count_subscribers(TOPIC) == 0


def test_planner_plans_for_the_temperature_that_is_published(serve, ros):
    serve(PlannerNode, '-p', 'takeover_timeout:=0.0', *COEFFICIENTS)
    commands = ros.collect(topics.FLUX_DENSITY_COMMAND)
    temperatures = ros.publisher(topics.TEMPERATURE, TOPIC)
    ros.publisher(topics.FLUX_DENSITY_APPLIED)
    diagnostics = ros.collect(topics.DIAGNOSTICS)
    setpoints = ros.publisher(topics.SETPOINT, '/planner/setpoint')

    def known():
        temperatures.publish(Temperature(temperature=40.0))
        return any(texts(y).get('temperature') == '40.00'
                   for x in diagnostics for y in x.status)

    ros.spin_until(known, 'the temperature in the diagnostics')
    setpoints.publish(Float64(data=1.2))
    hot = replace(paper_actuator(), thermal=Thermal(
        shear_modulus=0.003, remanence=-0.001)).at_temperature(40.0)
    ros.spin_until(lambda: any(
        abs(x.magnetic_field.z - Setup(hot).holding(1.2)) < 1e-12 for x in commands),
        'the level that holds the stretch there')


def test_plant_takes_the_temperature_that_is_published(serve, ros):
    serve(PlantNode, '-p', 'initial_stretch:=1.2', *COEFFICIENTS)
    samples = ros.collect(topics.JOINT_STATES)
    temperatures = ros.publisher(topics.TEMPERATURE, TOPIC)

    def stiffer():
        temperatures.publish(Temperature(temperature=298.15))  # which is refused
        temperatures.publish(Temperature(temperature=60.0))
        return samples and 1.0 < samples[-1].position[0] < 1.19

    ros.spin_until(stiffer, 'the block to stiffen')


@pytest.mark.slow
def test_temperature_of_a_block_that_its_coil_warms_is_recorded(start, ros, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text("""\
/**:
  ros__parameters:
    thermal.shear_modulus: 0.003
    thermal.remanence: -0.001
    thermal.rise: 2000.0
    thermal.time_constant: 1.0
/**/planner:
  ros__parameters:
    use_sim_time: true
/**/plant:
  ros__parameters:
    publish_clock: true
""")
    controller = start.hmsa('controller', '--ros-args', '--params-file', str(file))
    ros.spin_until(lambda: ros.node.count_publishers('planner/plan'), 'the planner', 300.0)
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "bag"}',
        '-p', 'record.all_topics:=true')
    for topic in ('/planner/plan', '/joint_states', '/flux_density_command', TOPIC):
        recorder.wait_for_output(topic)
    send = start.hmsa('send', '1.2:2', '1.1:2', '--wait')
    assert send.wait(60.0) == 0, send.output
    assert recorder.stop() == 0, recorder.output
    assert controller.stop() == 0, controller.output
    run = read_run(tmp_path / 'bag')
    seen = np.array([x for _, _, x in run.temperatures])
    assert seen[0] == pytest.approx(25.0, abs=0.1)
    assert seen.max() == pytest.approx(25.0 + 2000.0 * 0.0637 ** 2, abs=1.5)
    # The parameters of a run hold at its mean temperature, which its simulation leaves again.
    assert run.plant.thermal.reference == pytest.approx(run.temperature)
    assert verify_run(run).largest_difference < 1e-3
