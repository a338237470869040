"""
Play the commands of a bag to a fresh plant and record what it does.

    ros2 launch hmsa_ros replay.launch.py bag:=/tmp/left record_to:=/tmp/again

The player is the authority on time: it publishes ``/clock`` from the stamps of the bag. When it
is done, all of it ends.
"""

from datetime import datetime

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
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
    bag = ParameterValue(LaunchConfiguration('bag'), value_type=str)
    record_to = ParameterValue(LaunchConfiguration('record_to'), value_type=str)
    rate = ParameterValue(LaunchConfiguration('rate'), value_type=float)
    log_level = ['--log-level', LaunchConfiguration('log_level')]
    share = FindPackageShare('hmsa_ros')
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='Directory of the bag to play'),
        DeclareLaunchArgument(
            'record', default_value='true', choices=YES_OR_NO,
            description='Whether to record'),
        DeclareLaunchArgument(
            'record_to', default_value=f'hmsa_replay_{datetime.now():%Y%m%d_%H%M%S}',
            description='Directory of the new bag, which must not exist yet'),
        DeclareLaunchArgument('rate', default_value='1.0', description='Speed of playing'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the nodes'),
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'demo.yaml']),
            description='Parameters of the nodes'),
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
            parameters=[params_file, {'use_sim_time': True, 'storage.uri': record_to}],
            ros_arguments=log_level, condition=IfCondition(LaunchConfiguration('record')),
            output='screen'),
        Node(
            package='hmsa_ros', executable='plant', name='plant', namespace=namespace,
            parameters=[params_file, {'use_sim_time': True, 'publish_clock': False}],
            ros_arguments=log_level, output='screen'),
        Node(
            package='hmsa_ros', executable='player', name='player', namespace=namespace,
            parameters=[params_file, {
                'use_sim_time': False, 'storage.uri': bag, 'play.rate': rate,
                # Finer than the planner's lead_time, so that commands arrive ahead.
                'play.clock_publish_frequency': 4000.0,
                'play.wait_for_subscribers': ['flux_density_command'],
                'play.topics_to_filter': ['flux_density_command']}],
            ros_arguments=log_level, on_exit=Shutdown(reason='the bag has been played'),
            output='screen'),
        Node(
            package='rviz2', executable='rviz2', name='rviz', namespace=namespace,
            arguments=['-d', LaunchConfiguration('rviz_config')],
            parameters=[{'use_sim_time': True}],
            condition=IfCondition(LaunchConfiguration('rviz')), output='screen'),
    ])
