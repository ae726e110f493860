"""What a recording of the RealSense SDK (RealSense Viewer, rs-record) says, and where: a ROS 1 bag
with its own topics.

``/device_0/sensor_1/Color_0/image/data`` holds the images of a stream, ``info/camera_info`` below
the stream its camera, and ``tf/0`` a Transform that takes points of the reference of group 0, the
depth stream, to those of the stream: p_stream = R p_reference + t (a D435i: x = 0.015 for colour).
``option/Depth Units/value`` below the sensor is the metres per unit of depth; files of version 2
have it among the values of ``property``, newer ones also behind the pixels of each image. All
frames of such a file have the name "0" or "1", and depth is never aligned in it.
"""

import math
import re
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....errors import SequenceError
from .ros_tf import in_order, row_of

_STREAM = re.compile(r"(/device_\d+/sensor_\d+)/[^/]+_\d+(?=/)")
_TRANSFORM = re.compile(r"/tf/(\d+)$")
_UNITS = re.compile(r"(/device_\d+/sensor_\d+)/option/depth[ _]units/value$", re.IGNORECASE)
_PROPERTIES = re.compile(r"(/device_\d+/sensor_\d+)/property$")


def stream_of(topic: str) -> str:
    """The part of a topic that names the stream of the SDK, such as /device_0/sensor_1/Color_0;
    empty for others."""
    match = _STREAM.match(topic)
    return match[0] if match else ""


def is_told_by_sdk(topic: str) -> bool:
    """Whether a topic says what ``SdkCalibration`` collects."""
    is_transform = bool(stream_of(topic)) and bool(_TRANSFORM.search(topic))
    return is_transform or bool(_UNITS.match(topic)) or bool(_PROPERTIES.match(topic))


@dataclass
class SdkCalibration:
    """Places of the streams and units of depth, as the messages say them."""

    _places: dict[str, tuple[str, list[float]]] = field(default_factory=dict)
    """Stream -> group of its reference, and the transform from there to the stream."""
    _units_m: dict[str, list[float]] = field(default_factory=dict)
    """Sensor -> metres per unit, each value once."""

    def add(self, topic: str, message: Any) -> None:
        """Take what a message of such a topic says (``is_told_by_sdk``)."""
        if match := _UNITS.match(topic):
            self._add_units(match[1], float(message.data))
        elif match := _PROPERTIES.match(topic):
            if message.key.lower() == "depth units":
                self._add_units(match[1], float(message.value))
        elif match := _TRANSFORM.search(topic):
            self._places[stream_of(topic)] = match[1], row_of(message.translation, message.rotation)

    def add_units_of_image(self, topic: str, metres_per_unit: float) -> None:
        """Take the unit that an image has behind its pixels."""
        if metres_per_unit > 0 and (match := _STREAM.match(topic)):
            self._add_units(match[1], metres_per_unit)

    def transform(self, source: str, target: str) -> Float[Tensor, "4 4"] | None:
        """From the stream of the topic ``source`` to that of ``target``, float64; None where the
        file lacks one."""
        places = [self._places.get(stream_of(topic)) for topic in (source, target)]
        if places[0] is None or places[1] is None or places[0][0] != places[1][0]:
            return None
        T_source_reference, T_target_reference = (
            in_order([0.0], [row]).poses[0] for _, row in (places[0], places[1])
        )
        return T_target_reference @ torch.linalg.inv(T_source_reference)

    def units_per_m(self, topic: str, source: str) -> float:
        """Stored depth of one metre in the images of a topic; 0 where the file does not say it.

        Raises:
            SequenceError: it changes during the recording, or is no length.
        """
        match = _STREAM.match(topic)
        values = self._units_m.get(match[1], []) if match else []
        if not values:
            return 0.0
        if len(values) > 1 or not 0 < values[0] < math.inf:
            values_text = ", ".join(f"{value:g}" for value in values)
            raise SequenceError(
                f"{source}: Depth Units of {topic} are {values_text}; expected one length, in "
                "metres; give --depth-scale, the stored value of one metre"
            )
        return 1.0 / values[0]

    def _add_units(self, sensor: str, metres_per_unit: float) -> None:
        value = float(f"{metres_per_unit:.6g}")  # 0.001 as float32 is not 0.001
        values = self._units_m.setdefault(sensor, [])
        if value not in values:
            values.append(value)
