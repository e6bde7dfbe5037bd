"""The player's cameras: messages of a bag, unpacked if they are compressed, on the topics a driver has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pred_core.bag import images
from pred_core.bag.wire import camera_topics
from pred_ros import convert, image_messages, qos


class PlayedPictures:
    """Publishers for the camera topics `topics` of the bags; reliable, so that every kind of reader is served."""

    def __init__(self, node: Node, topics: Sequence[str]):
        self._out: dict[str, Publisher] = {}
        self._topics = camera_topics(topics)
        for topic, (_, below) in self._topics.items():
            kind, profile = _kind(below), qos.latched() if below == images.POSE else qos.points_complete()
            if kind is not None:
                self._out[topic] = node.create_publisher(
                    Image if kind is CompressedImage else kind, images.raw_topic(topic), profile
                )

    @property
    def color(self) -> Publisher | None:
        """The first camera's colour, None without cameras."""
        return next((out for topic, out in self._out.items() if f"/{images.COLOR}" in topic), None)

    def play(self, topic: str, data: bytes, stamp: int) -> bool:
        """Publish the CDR bytes of a message with another stamp [ns]; False for a topic that no driver has.

        Raises: BagError if a picture cannot be unpacked; ConfigError without OpenCV.
        """
        camera, below = self._topics[topic]
        kind = _kind(below)
        if kind is None:
            return False
        message: Any = deserialize_message(data, kind)
        if kind is CompressedImage:
            if below == images.DEPTH_COMPRESSED:
                message = image_messages.depth_to_message(camera, stamp, images.read_depth_compressed(message, topic))
            else:
                message = image_messages.color_to_message(camera, stamp, images.read_color_compressed(message, topic))
        message.header.stamp = convert.time_at(stamp)
        self._out[topic].publish(message)
        return True


def _kind(below: str) -> type | None:
    if below in (images.COLOR_COMPRESSED, images.DEPTH_COMPRESSED):
        return CompressedImage
    if below in (images.COLOR, images.DEPTH):
        return Image
    return {images.INFO: CameraInfo, images.POSE: PoseStamped}.get(below)
