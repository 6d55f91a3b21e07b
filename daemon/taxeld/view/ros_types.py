"""ROS 2 message definitions, as `.msg` files have them: those of Humble and later.

The one place where the fields of a ROS message are written down. The MCAP export puts the text of
these definitions into its file; the bridge `taxeld_ros2` makes its DDS types of them.
"""

TYPES = {  # fields in the order of the wire
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "std_msgs/ColorRGBA": "float32 r, float32 g, float32 b, float32 a",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/PoseArray": "std_msgs/Header header, geometry_msgs/Pose[] poses",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": (
        "std_msgs/Header header, geometry_msgs/PoseWithCovariance pose"
    ),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "diagnostic_msgs/KeyValue": "string key, string value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level, string name, string message, string hardware_id, "
        "diagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": (
        "std_msgs/Header header, diagnostic_msgs/DiagnosticStatus[] status"
    ),
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, "
        "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u, float32 v",
    "visualization_msgs/MeshFile": "string filename, uint8[] data",
    "visualization_msgs/Marker": (
        "std_msgs/Header header, string ns, int32 id, int32 type, int32 action, "
        "geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color, "
        "builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points, "
        "std_msgs/ColorRGBA[] colors, string texture_resource, "
        "sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates, "
        "string text, string mesh_resource, visualization_msgs/MeshFile mesh_file, "
        "bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
}
_RULE = "=" * 80


def fields(name: str) -> list[tuple[str, str]]:
    """Type and name of each field of `package/Type`, in the order of the wire."""
    pairs = (field.split(" ") for field in TYPES[name].split(", "))
    return [(kind, field) for kind, field in pairs]


def definition(name: str) -> str:
    """The text of `package/Type` and of all types that it refers to, as an MCAP file has it.

    The parts are separated by a line of 80 `=` (https://mcap.dev/spec/registry, `ros2msg`).
    """
    needed = [name]
    for one in needed:
        kinds = (kind.partition("[")[0] for kind, _ in fields(one))
        needed += [kind for kind in kinds if kind in TYPES and kind not in needed]
    texts = [TYPES[one].replace(", ", "\n") for one in needed]
    others = (f"{_RULE}\nMSG: {one}\n{text}" for one, text in zip(needed, texts, strict=True))
    return "\n".join([texts[0], *list(others)[1:]])
