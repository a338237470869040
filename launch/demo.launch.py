"""
Start the planner, the simulated actuator and, unless told otherwise, the recorder.

    ros2 launch hmsa_ros demo.launch.py namespace:=left bag:=/tmp/left use_sim_time:=true

With ``use_sim_time`` the plant is the authority on simulated time and publishes ``/clock``.
"""

from datetime import datetime

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and nodes."""
    namespace = LaunchConfiguration('namespace')
    params_file = LaunchConfiguration('params_file')
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    bag = ParameterValue(LaunchConfiguration('bag'), value_type=str)
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the nodes'),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution(
                [FindPackageShare('hmsa_ros'), 'config', 'demo.yaml']),
            description='Parameters of the nodes'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=['true', 'false'],
            description='Whether the plant publishes /clock and the others follow it'),
        DeclareLaunchArgument(
            'record', default_value='true', choices=['true', 'false'],
            description='Whether to record'),
        DeclareLaunchArgument(
            'bag', default_value=f'hmsa_{datetime.now():%Y%m%d_%H%M%S}',
            description='Directory of the bag, which must not exist yet'),
        Node(
            package='hmsa_ros', executable='recorder', name='recorder', namespace=namespace,
            parameters=[params_file, {'use_sim_time': use_sim_time, 'storage.uri': bag}],
            condition=IfCondition(LaunchConfiguration('record')), output='screen'),
        Node(
            package='hmsa_ros', executable='plant', name='plant', namespace=namespace,
            parameters=[params_file, {'use_sim_time': False, 'publish_clock': use_sim_time}],
            output='screen'),
        Node(
            package='hmsa_ros', executable='planner', name='planner', namespace=namespace,
            parameters=[params_file, {'use_sim_time': use_sim_time}], output='screen'),
    ])
