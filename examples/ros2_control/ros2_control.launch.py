"""
Start ros2_control with a trajectory controller, the bridge, the planner and a simulated actuator.

    ros2 launch examples/ros2_control/ros2_control.launch.py lead_time:=0.005

Needs ros2_controllers and joint_state_topic_hardware_interface. With ``plant:=false`` a driver
in the namespace ``hmsa`` takes the place of the simulated actuator.
"""

from pathlib import Path
import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

FOLDER = Path(__file__).resolve().parent
# Of planner, plant and bridge: their joint_states are not those of the broadcaster.
NAMESPACE = 'hmsa'


def generate_launch_description() -> LaunchDescription:
    """Return arguments and processes."""
    description = (FOLDER / 'actuator.urdf').read_text()
    controllers = str(FOLDER / 'controllers.yaml')
    lead_time = ParameterValue(LaunchConfiguration('lead_time'), value_type=float)
    return LaunchDescription([
        DeclareLaunchArgument(
            'lead_time', default_value='0.005',
            description='Time in s from a setpoint to its first command.'),
        DeclareLaunchArgument(
            'plant', default_value='true', description='Whether to simulate the actuator.'),
        Node(
            package='hmsa_ros', executable='planner', namespace=NAMESPACE,
            parameters=[{'lead_time': lead_time}]),
        Node(
            package='hmsa_ros', executable='plant', namespace=NAMESPACE,
            condition=IfCondition(LaunchConfiguration('plant'))),
        ExecuteProcess(
            cmd=[sys.executable, str(FOLDER / 'bridge.py'), '--ros-args', '-r',
                 f'__ns:=/{NAMESPACE}'], output='screen'),
        Node(
            package='robot_state_publisher', executable='robot_state_publisher',
            parameters=[{'robot_description': ParameterValue(description, value_type=str)}]),
        # It reads the description from the topic of the publisher above.
        Node(
            package='controller_manager', executable='ros2_control_node',
            parameters=[controllers]),
        Node(
            package='controller_manager', executable='spawner',
            arguments=['joint_state_broadcaster', 'joint_trajectory_controller',
                       '--param-file', controllers]),
    ])
