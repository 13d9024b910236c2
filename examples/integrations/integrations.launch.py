# Starts one node of this package: ros2 launch tilt_ropter_nodes integrations.launch.py node:=px4_node
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description():
    text = {name: LaunchConfiguration(name)
            for name in ("node", "namespace", "vehicle", "level", "mission", "trajectory")}
    return LaunchDescription([
        DeclareLaunchArgument("node", default_value="px4_node", choices=["px4_node", "ros2_node"]),
        DeclareLaunchArgument("namespace", default_value=""),
        DeclareLaunchArgument("vehicle", default_value="", description="path of a JSON file"),
        DeclareLaunchArgument("level", default_value="", description="wrench or actuator"),
        DeclareLaunchArgument("mission", default_value="", description="JSON file or name"),
        DeclareLaunchArgument("trajectory", default_value="", description="CSV file"),
        DeclareLaunchArgument("hover_z", default_value="1.5", description="height [m]"),
        DeclareLaunchArgument("use_sim_time", default_value="false"),
        Node(
            package="tilt_ropter_nodes",
            executable=text["node"],
            name=text["node"],
            namespace=text["namespace"],
            output="screen",
            parameters=[{
                "vehicle": ParameterValue(text["vehicle"], value_type=str),
                "level": ParameterValue(text["level"], value_type=str),
                "mission": ParameterValue(text["mission"], value_type=str),
                "trajectory": ParameterValue(text["trajectory"], value_type=str),
                "hover_z": ParameterValue(LaunchConfiguration("hover_z"), value_type=float),
                "use_sim_time": ParameterValue(
                    LaunchConfiguration("use_sim_time"), value_type=bool),
            }],
        ),
    ])
