"""The joystick example, with its planner and plant."""

from pathlib import Path
import runpy

import pytest
from sensor_msgs.msg import JointState, Joy

from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode

FILE = Path(__file__).resolve().parent.parent / 'examples' / 'joystick' / 'joystick.py'
NAN = float('nan')


@pytest.mark.ros
def test_axes_move_the_actuator_and_a_button_stops_it(serve, ros):
    serve(runpy.run_path(str(FILE))['Joystick'], PlannerNode, PlantNode,
          '-p', 'lead_time:=0.5', '-p', 'joystick:throttle_axis:=0')
    setpoints = ros.collect('std_msgs/msg/Float64', '/planner/setpoint', 10)
    status = ros.collect('diagnostic_msgs/msg/DiagnosticStatus', '/planner/status', 10)
    samples = ros.collect(JointState, '/joint_states', 10)
    joy = ros.publisher(Joy, '/joy', 50)

    def move(*axes, pressed=0):
        joy.publish(Joy(axes=[float(x) for x in axes], buttons=[pressed]))

    for axes in (
            [], [1.0], [1.0, NAN], [NAN, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 0.995], [0.0, 1.0],
            [1.0, -9.0]):
        move(*axes)
    ros.spin_until(lambda: len(setpoints) == 3, 'three setpoints')
    assert [x.data for x in setpoints] == pytest.approx([1.2, 1.15, 1.0])
    move(1.0, 0.5)
    ros.spin_until(lambda: abs(samples[-1].position[0] - 1.15) < 1e-6, 'the arrival')

    def plan():
        return next(int(x.value) for x in status[-1].values if x.key == 'plan')

    before = plan()
    # Not on while it is pressed, nor when it is let go.
    for pressed in (1, 1, 0):
        move(1.0, 0.5, pressed=pressed)
    ros.spin_until(lambda: plan() > before, 'the stop')
    assert len(setpoints) == 4
    move(1.0, 0.0)
    ros.spin_until(lambda: abs(samples[-1].position[0] - 1.1) < 1e-6, 'the next arrival')
    assert len(setpoints) == 5
