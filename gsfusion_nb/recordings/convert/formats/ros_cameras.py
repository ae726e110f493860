"""The cameras of a ROS bag: intrinsics of colour and depth, and whether depth is registered to
colour.

Names of frames prove something only where they name a frame: two empty names, or "0" everywhere,
are no evidence.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....data.lens import CameraModel, same_proportions, same_rays
from ....errors import SequenceError
from ..camera_numbers import model_of
from ..recording import ConvertOptions, OptionNeeded
from .realsense_sdk import SdkCalibration, stream_of
from .ros_tf import TransformTree

_BROWN = ("plumb_bob", "rational_polynomial", "brown conrady", "none", "")
_FISHEYE = ("equidistant", "fisheye", "kannala brandt4")
_EITHER_WAY = ("inverse brown conrady", "modified brown conrady")
_ALIGNED = ("aligned", "registered")
MOST_DISTORTION = 14


@dataclass(frozen=True, eq=False)
class RosCameras:
    """Cameras of the frames of a bag, as ``RecordedFrame`` has them."""

    colour: CameraModel | None
    depth: CameraModel | None = None
    T_colour_depth: Float[Tensor, "4 4"] | None = None
    note: str = ""
    """How it is known whether depth is registered."""


@dataclass
class RosCalibration:
    """What the messages of a bag say about its cameras."""

    path: Path
    frames: dict[str, str] = field(default_factory=dict)
    """Frame of the images, by topic."""
    info: dict[str, Any] = field(default_factory=dict)
    """First CameraInfo, by topic."""
    tree: TransformTree = field(default_factory=TransformTree)
    sdk: SdkCalibration = field(default_factory=SdkCalibration)

    def cameras(self, colour: str, depth: str, options: ConvertOptions) -> RosCameras:
        """Cameras of the topics ``colour`` and ``depth``.

        Raises:
            OptionNeeded: depth is another camera's, of which the bag does not say enough.
            SequenceError: a camera that cannot be read.
        """
        infos = {topic: self._info_of(topic) for topic in (colour, depth)}
        own = infos[depth] if infos[depth] is not infos[colour] else None
        model = None if options.intrinsics else self._model(infos[colour], colour)
        if options.depth_intrinsics == "colour":
            return RosCameras(
                model, note="depth is taken as registered to colour (--depth-intrinsics)"
            )
        if options.depth_intrinsics or options.T_colour_depth:
            depth_model = None if options.depth_intrinsics else self._model(own, depth)
            T = None if options.T_colour_depth else self._place(depth, colour)
            return RosCameras(
                model,
                depth_model,
                T,
                "depth was registered to colour with the camera of the options",
            )
        if any(word in depth for word in _ALIGNED):
            return RosCameras(
                model, note="depth is taken as registered to colour (its topic says so)"
            )
        depth_model = self._model(own, depth)
        if stream_of(colour) and stream_of(depth):
            return self._of_sdk(model, depth_model, colour, depth)
        return self._of_frames(model, depth_model, colour, depth)

    def _place(self, depth: str, colour: str) -> Float[Tensor, "4 4"] | None:
        """From the camera of depth to that of colour, as the bag says it; None where it does
        not."""
        if stream_of(colour) and stream_of(depth):
            return self.sdk.transform(depth, colour)
        frames = [self.frames.get(topic, "") for topic in (depth, colour)]
        if frames[0] == frames[1] or not all(is_frame_name(frame) for frame in frames):
            return None
        return self.tree.between(*frames)

    def _of_sdk(
        self, model: CameraModel | None, own: CameraModel | None, colour: str, depth: str
    ) -> RosCameras:
        T = self._place(depth, colour)
        if own is None:
            raise self._needed(
                "depth_intrinsics", f"is not aligned to colour, and {depth} has no camera_info"
            )
        if T is None:
            raise self._needed(
                "T_colour_depth", "is not aligned to colour, and the tf of the streams is missing"
            )
        note = (
            f"depth ({stream_of(depth)}) was registered to colour ({stream_of(colour)}), as tf says"
        )
        return RosCameras(model, own, T, note)

    def _of_frames(
        self, model: CameraModel | None, own: CameraModel | None, colour: str, depth: str
    ) -> RosCameras:
        of_colour, of_depth = (self.frames.get(topic, "") for topic in (colour, depth))
        are_frames = is_frame_name(of_colour) and is_frame_name(of_depth)
        T = self._place(depth, colour)
        if T is not None and own is not None:
            return RosCameras(
                model,
                own,
                T,
                f"depth ({of_depth}) was registered to colour ({of_colour}) by tf_static",
            )
        if own is not None and model is not None and _are_one(own, model):
            return RosCameras(
                model, note="depth is taken as registered to colour (the cameras of both are equal)"
            )
        if are_frames and of_colour == of_depth:
            note = f"depth is taken as registered to colour (both are in the frame {of_colour})"
            if own is not None:
                note = f"depth was resampled to colour's camera (both are in the frame {of_colour})"
            return RosCameras(model, own, note=note)
        if own is not None:
            why = "tf_static lacks it" if are_frames else "the frames of the images have no names"
            note = (
                f"depth ({of_depth}) was registered to colour ({of_colour}) WITHOUT their offset, "
                f"since {why}; --T-colour-depth gives it"
            )
            return RosCameras(model, own, note=note)
        if are_frames:
            frames = f"is in the frame {shown(of_depth)} and colour in {shown(of_colour)}"
            raise self._needed(
                "depth_intrinsics", f"{frames}, and no camera_info tells depth's camera"
            )
        note = (
            "depth is taken as registered to colour, which nothing in the bag says; if it is not, "
            "give --depth-intrinsics and --T-colour-depth"
        )
        return RosCameras(model, note=note)

    def _needed(self, option: str, why: str) -> OptionNeeded:
        what, question = {
            "depth_intrinsics": (
                "'fx fy cx cy' of the depth images",
                "What are the intrinsics of the depth images?",
            ),
            "T_colour_depth": (
                "a file of 16 numbers",
                "Which file holds the transform from depth to colour?",
            ),
        }[option]
        return OptionNeeded(
            f"{self.path}: depth {why}; give --{option.replace('_', '-')} {what}, or "
            "--depth-intrinsics colour if it is registered to colour",
            option=option,
            question=f"Depth {why}. {question}",
        )

    def _info_of(self, topic: str) -> Any:
        """CameraInfo beside an image topic, or below info/, in the nearest common namespace."""
        parts = topic.split("/")
        for n in range(len(parts) - 1, 1, -1):
            for name in ("camera_info", "info/camera_info"):
                info = self.info.get("/".join([*parts[:n], name]))
                if info is not None:
                    return info
        return next(iter(self.info.values())) if len(self.info) == 1 else None

    def _model(self, info: Any, topic: str) -> CameraModel | None:
        """Camera of a CameraInfo; of a rectified topic, of its projection matrix P. None for an
        uncalibrated one."""
        if info is None:
            return None
        source = f"{self.path}: the camera_info of {topic}"
        K, D, P = (
            [float(v) for v in getattr(info, n, getattr(info, n.lower(), ()))]
            for n in ("K", "D", "P")
        )
        if len(D) > MOST_DISTORTION:
            raise SequenceError(
                f"{source} has {len(D)} numbers of distortion; expected at most {MOST_DISTORTION}"
            )
        if re.search(r"(^|[/_])rect", topic) and P[0] > 0:
            return model_of(
                *_cropped([P[0], P[5], P[2], P[6]], info),
                source,
                centre=0.0,
            )
        if not any(K[:6]):
            return None
        kind = info.distortion_model.lower()
        if any(D) and kind in _EITHER_WAY:
            raise OptionNeeded(
                f"{source} has the distortion model {shown(info.distortion_model)} with the "
                f"numbers {' '.join(f'{v:g}' for v in D)}, which programs apply in either "
                "direction; give --intrinsics 'fx fy cx cy k1 k2 p1 p2 k3' as OpenCV has them, or "
                "without the last five",
                option="intrinsics" if "depth" not in topic.lower() else "depth_intrinsics",
                question=f"What is the camera of {topic}, fx fy cx cy [k1 k2 p1 p2 k3] as in "
                "OpenCV?",
            )
        if any(D) and kind not in (*_BROWN, *_FISHEYE):
            models_text = ", ".join(("plumb_bob", "rational_polynomial", "equidistant"))
            raise SequenceError(
                f"{source} has the distortion model {shown(info.distortion_model)}; known: "
                f"{models_text}; or give --intrinsics"
            )
        fisheye = kind in _FISHEYE and any(D)
        values, size = _cropped(
            [K[0], K[4], K[2], K[5]],
            info,
        )
        return model_of(
            values,
            size,
            source,
            centre=0.0,
            distortion=tuple(D[:4] if fisheye else D),
            fisheye=fisheye,
        )


def is_frame_name(name: str) -> bool:
    """Whether a frame_id names a frame: a number, as a counter or a version, does not."""
    return bool(name) and not name.isdecimal()


def _cropped(
    values: list[float],
    info: Any,
) -> tuple[list[float], tuple[int, int]]:
    """fx, fy, cx, cy and the size of the part of the sensor that the images show: K is of the whole
    of it (REP 104)."""
    roi = info.roi
    size = (int(info.width), int(info.height))
    if roi.width and roi.height:
        values = [values[0], values[1], values[2] - roi.x_offset, values[3] - roi.y_offset]
        size = (int(roi.width), int(roi.height))
    return values, size


def _are_one(depth: CameraModel, colour: CameraModel) -> bool:
    """Whether both have the same rays, at whatever resolution."""
    c = colour.camera
    d = depth.camera
    if not same_proportions((c.width, c.height), (d.width, d.height)):
        return False
    if depth.distortion != colour.distortion or depth.fisheye != colour.fisheye:
        return False
    return same_rays(CameraModel(c.resized(d.width, d.height)), d)
