"""The ROS 2 messages that are read: their names, and the text that describes them in a log."""

from __future__ import annotations

import re

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_FIELDS = {
    POINT_CLOUD: "std_msgs/Header header, uint32 height, uint32 width, "
    "sensor_msgs/PointField[] fields, bool is_bigendian, uint32 point_step, uint32 row_step, "
    "uint8[] data, bool is_dense",
    LASER_SCAN: "std_msgs/Header header, float32 angle_min, float32 angle_max, "
    "float32 angle_increment, float32 time_increment, float32 scan_time, float32 range_min, "
    "float32 range_max, float32[] ranges, float32[] intensities",
    ODOMETRY: "std_msgs/Header header, string child_frame_id, "
    "geometry_msgs/PoseWithCovariance pose, geometry_msgs/TwistWithCovariance twist",
    POSE: "std_msgs/Header header, geometry_msgs/Pose pose",
    POSE_WITH_COVARIANCE: "std_msgs/Header header, geometry_msgs/PoseWithCovariance pose",
    TRANSFORM: "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp, string frame_id",
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "sensor_msgs/msg/PointField": "uint8 INT8=1, uint8 UINT8=2, uint8 INT16=3, uint8 UINT16=4, "
    "uint8 INT32=5, uint8 UINT32=6, uint8 FLOAT32=7, uint8 FLOAT64=8, string name, uint32 offset, "
    "uint8 datatype, uint32 count",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist, float64[36] covariance",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x 0, float64 y 0, float64 z 0, float64 w 1",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation, "
    "geometry_msgs/Quaternion rotation",
}

ROS_SCANS = (POINT_CLOUD, LASER_SCAN)
ROS_TRANSFORMS = (TRANSFORMS, TRANSFORM, ODOMETRY)  # they name both frames
ROS_POSES = (POSE, POSE_WITH_COVARIANCE)  # they do not say of what
ROS_SCHEMAS = (*ROS_SCANS, *ROS_TRANSFORMS, *ROS_POSES)

_DDS_NAME = re.compile(r"(\w+)::msg::dds_::(\w+)_")


def ros_schema(name: str) -> str:
    """`pkg/msg/Type` of a type as ROS, DDS or rosbag2 write it; any other name as it is."""
    match = _DDS_NAME.fullmatch(name)
    if match is not None:
        return f"{match.group(1)}/msg/{match.group(2)}"
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def definition(schema: str) -> str:
    """The message and all that it consists of, in the text that MCAP calls `ros2msg`."""
    order = [schema]
    for name in order:
        for field in _FIELDS[name].split(", "):
            part = ros_schema(field.split()[0].split("[")[0])
            if part in _FIELDS and part not in order:
                order.append(part)
    texts = [_FIELDS[name].replace(", ", "\n") + "\n" for name in order]
    names = (f"{'=' * 80}\nMSG: {name.replace('/msg/', '/')}\n" for name in order[1:])
    return texts[0] + "".join(f"{n}{t}" for n, t in zip(names, texts[1:], strict=True))
