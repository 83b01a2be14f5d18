"""Definitions of the ROS messages that the common packages lack.

Bags carry definitions, too, but those are not run: the layouts that ever circulated are few, and a message whose length
fits none of them is rejected.
"""

DETECTION_ARRAY = "vision_msgs/msg/Detection2DArray"
"""Type of a detector's result for one image."""
_IDS = {"number": "int64", "text": "string"}
_TAILS = {
    "id": "string id",
    "image": "sensor_msgs/Image source_img",
    "tracked": "sensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id",
}
LAYOUTS = ("text_id", "number_image", "text_tracked", "number_tracked", "text_image", "number_id")
"""Layouts of camera boxes: ids as numbers (ROS 1) or as text, and what follows the box. First that of vision_msgs since
3.0, where parts are nested, which leaves the bytes as they were, then that of ROS 1."""


def name_layout(layout: str) -> str:
    """Return the name of the type that stands for Detection2DArray in a layout."""
    return f"vision_{layout}/msg/Detection2DArray"


def _define(layout: str) -> dict[str, str]:
    ids, tail = layout.split("_")
    parts = {
        "BoundingBox2D": "float64 x\nfloat64 y\nfloat64 theta\nfloat64 size_x\nfloat64 size_y",
        "Result": f"{_IDS[ids]} id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
        "Detection2D": f"std_msgs/Header header\nResult[] results\nBoundingBox2D bbox\n{_TAILS[tail]}",
        "Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
    }
    return {f"vision_{layout}/msg/{name}": text for name, text in parts.items()}


DEFINITIONS = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms",
    **{name: text for layout in LAYOUTS for name, text in _define(layout).items()},
}
"""Texts of the definitions by type."""
