"""
Play the commands of a bag to a fresh plant and record what it does.

    ros2 launch hmsa_ros replay.launch.py bag:=/tmp/left record_to:=/tmp/again

The player is the authority on time: it publishes ``/clock`` from the stamps of the bag.
"""

from datetime import datetime

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and nodes."""
    namespace = LaunchConfiguration('namespace')
    params_file = LaunchConfiguration('params_file')
    bag = ParameterValue(LaunchConfiguration('bag'), value_type=str)
    record_to = ParameterValue(LaunchConfiguration('record_to'), value_type=str)
    rate = ParameterValue(LaunchConfiguration('rate'), value_type=float)
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='Directory of the bag to play'),
        DeclareLaunchArgument(
            'record_to', default_value=f'hmsa_replay_{datetime.now():%Y%m%d_%H%M%S}',
            description='Directory of the new bag, which must not exist yet'),
        DeclareLaunchArgument('rate', default_value='1.0', description='Speed of playing'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the nodes'),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution(
                [FindPackageShare('hmsa_ros'), 'config', 'demo.yaml']),
            description='Parameters of the nodes'),
        Node(
            package='hmsa_ros', executable='recorder', name='recorder', namespace=namespace,
            parameters=[params_file, {'use_sim_time': True, 'storage.uri': record_to}],
            output='screen'),
        Node(
            package='hmsa_ros', executable='plant', name='plant', namespace=namespace,
            parameters=[params_file, {'use_sim_time': True, 'publish_clock': False}],
            output='screen'),
        Node(
            package='hmsa_ros', executable='player', name='player', namespace=namespace,
            parameters=[params_file, {
                'use_sim_time': False, 'storage.uri': bag, 'play.rate': rate,
                # Finer than the planner's lead_time, so that commands arrive ahead.
                'play.clock_publish_frequency': 4000.0,
                'play.wait_for_subscribers': ['flux_density_command'],
                'play.topics_to_filter': ['flux_density_command']}],
            output='screen'),
    ])
