"""
Start the planner, the simulated actuator and, unless told otherwise, the recorder.

    ros2 launch hmsa_ros demo.launch.py namespace:=left bag:=/tmp/left use_sim_time:=true

With ``use_sim_time`` the plant is the authority on simulated time and publishes ``/clock``. With
``plant:=false`` a driver of real hardware takes its place, and time is the wall clock's or that
of whoever publishes ``/clock``. ``rviz:=true`` shows the actuators in RViz.
"""

from datetime import datetime

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

YES_OR_NO = ['true', 'false']


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and nodes."""
    namespace = LaunchConfiguration('namespace')
    params_file = LaunchConfiguration('params_file')
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    bag = ParameterValue(LaunchConfiguration('bag'), value_type=str)
    log_level = ['--log-level', LaunchConfiguration('log_level')]
    share = FindPackageShare('hmsa_ros')
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the nodes'),
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'demo.yaml']),
            description='Parameters of the nodes'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=YES_OR_NO,
            description='Whether the plant publishes /clock and the others follow it'),
        DeclareLaunchArgument(
            'plant', default_value='true', choices=YES_OR_NO,
            description='Whether to simulate; false for a driver of real hardware'),
        DeclareLaunchArgument(
            'record', default_value='true', choices=YES_OR_NO,
            description='Whether to record'),
        DeclareLaunchArgument(
            'bag', default_value=f'hmsa_{datetime.now():%Y%m%d_%H%M%S}',
            description='Directory of the bag, which must not exist yet'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=YES_OR_NO,
            description='Whether to start RViz, which must be installed'),
        DeclareLaunchArgument(
            'rviz_config',
            default_value=PathJoinSubstitution([share, 'config', 'rviz', 'hmsa.rviz']),
            description='What RViz shows'),
        DeclareLaunchArgument(
            'log_level', default_value='info',
            description='Least severity that is logged: debug, info, warn, error or fatal'),
        Node(
            package='hmsa_ros', executable='recorder', name='recorder', namespace=namespace,
            parameters=[params_file, {'use_sim_time': use_sim_time, 'storage.uri': bag}],
            ros_arguments=log_level, condition=IfCondition(LaunchConfiguration('record')),
            output='screen'),
        Node(
            package='hmsa_ros', executable='plant', name='plant', namespace=namespace,
            parameters=[params_file, {'use_sim_time': False, 'publish_clock': use_sim_time}],
            ros_arguments=log_level, condition=IfCondition(LaunchConfiguration('plant')),
            output='screen'),
        Node(
            package='hmsa_ros', executable='planner', name='planner', namespace=namespace,
            parameters=[params_file, {'use_sim_time': use_sim_time}],
            ros_arguments=log_level, output='screen'),
        Node(
            package='rviz2', executable='rviz2', name='rviz', namespace=namespace,
            arguments=['-d', LaunchConfiguration('rviz_config')],
            parameters=[{'use_sim_time': use_sim_time}],
            condition=IfCondition(LaunchConfiguration('rviz')), output='screen'),
    ])
