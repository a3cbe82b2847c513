"""Send image topics of ROS 2 to `imgcal watch ADDRESS`, and the poses that it publishes back to ROS.

Usage: python ros2_bridge.py tcp://127.0.0.1:5555 cam01=/rig/cam01/image_raw cam02=/rig/cam02/image_raw ...
           [poses=tcp://127.0.0.1:5556]
and imgcal watch tcp://127.0.0.1:5555 --rig rig.yaml --object object.csv --out out/watch [--poses tcp://127.0.0.1:5556]

Limits: it needs rclpy of a sourced ROS 2 and pyzmq in the same Python. It has been tested without ROS only: message
conversion is tested, the node is not. It accepts uncompressed mono8 and mono16. A frame's time is its header's stamp;
the driver must set it to the middle of the exposure, with synchronized clocks. Poses become PoseWithCovarianceStamped
in metres, with the covariance in ROS's order (position, then rotation), in the frame `rig`.
"""

import json
import sys
from typing import Any

import numpy as np
import zmq

KINDS = {"mono8": "uint8", "8UC1": "uint8", "mono16": "uint16", "16UC1": "uint16"}


def frame_parts(camera: str, message: Any) -> list[bytes]:
    """Make the two parts of a message to imgcal: a header, and contiguous little-endian pixels."""
    kind = np.dtype(KINDS[message.encoding])
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[
        :, : message.width * kind.itemsize
    ]
    pixels = np.ascontiguousarray(rows).view(kind.newbyteorder(">" if message.is_bigendian else "<"))
    seconds = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    header = {"camera": camera, "time": seconds, "width": message.width, "height": message.height, "type": str(kind)}
    return [json.dumps(header).encode(), pixels.astype(kind.newbyteorder("<")).tobytes()]


def pose_values(line: str | bytes) -> tuple[Any, Any, Any, float] | None:
    """Parse a line that imgcal publishes: position (m), quaternion (x, y, z, w), covariance (36,); None = no pose."""
    from scipy.spatial.transform import Rotation

    entry = json.loads(line)
    if entry["rig_from_object"] is None:
        return None
    matrix, order = np.array(entry["rig_from_object"]), [3, 4, 5, 0, 1, 2]
    unit = np.array([1e-3] * 3 + [1.0] * 3)
    covariance = np.array(entry["covariance"])[np.ix_(order, order)] * np.outer(unit, unit)
    return 1e-3 * matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat(), covariance.flatten(), entry["time"]


def main() -> None:
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    topics = dict(argument.split("=", 1) for argument in sys.argv[2:])
    poses = topics.pop("poses", None)
    rclpy.init()
    node, context = rclpy.create_node("imgcal_bridge"), zmq.Context()
    frames = context.socket(zmq.PUB)
    frames.bind(sys.argv[1])
    for camera, topic in topics.items():

        def send(message: Any, camera: str = camera) -> None:
            frames.send_multipart(frame_parts(camera, message))

        node.create_subscription(Image, topic, send, qos_profile_sensor_data)
    if poses is not None:
        found, publisher = context.socket(zmq.SUB), node.create_publisher(PoseWithCovarianceStamped, "object_pose", 10)
        found.setsockopt(zmq.SUBSCRIBE, b"")
        found.connect(poses)

        def publish() -> None:
            while found.poll(0):
                values = pose_values(found.recv())
                if values is None:
                    continue
                place, turn, covariance, seconds = values
                message = PoseWithCovarianceStamped()
                message.header.frame_id = "rig"
                message.header.stamp.sec, message.header.stamp.nanosec = int(seconds), int(seconds % 1 * 1e9)
                position, orientation = message.pose.pose.position, message.pose.pose.orientation
                position.x, position.y, position.z = map(float, place)
                orientation.x, orientation.y, orientation.z, orientation.w = map(float, turn)
                message.pose.covariance = covariance.tolist()
                publisher.publish(message)

        node.create_timer(0.005, publish)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
