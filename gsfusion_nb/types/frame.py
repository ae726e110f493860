"""One RGB-D observation with its pose, and what is made of the arrays that it is given."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from ..arrays import colour_tensor, depth_tensor, pose_tensor
from ..checks import check_shape
from ..errors import ArgumentError, UnknownNameError
from .camera import Camera


def rgb_of_bytes(levels: UInt8[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Colour 0..1 of grey levels 0..255."""
    return levels.float().div_(255.0)


@dataclass(frozen=True, kw_only=True, eq=False, init=False)
class Frame:
    """One RGB-D observation with its pose.

    ``Frame(rgb=...)`` takes colour as it is: an 8-bit image as uint8, anything else as float32,
    0..1. Bytes are carried as bytes; ``frame.rgb`` makes floats of them when they are first asked
    for, and keeps them.

    Images and pose may be NumPy arrays, which are copied: colour in the order red, green, blue as
    uint8 or as floats in 0..1, depth as floats in metres. ``conversions`` says what was made of
    them.

    Raises:
        ValueError: a tensor of the wrong type or shape, or an array whose scale is not known, such
            as depth in whole numbers.
    """

    index: int
    """Position in the source sequence (stride and held-out frames keep the source's numbers)."""
    timestamp_s: float
    """Time of the observation, seconds."""
    colour: UInt8[Tensor, "H W 3"] | Float[Tensor, "H W 3"]
    """Colour as it was given: grey levels 0..255 as uint8, or float32, 0..1."""
    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where there is none, never NaN."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose, OpenCV axes, metres."""
    extra: Mapping[str, Shaped[Tensor, "H W *C"]]
    """Further images of this frame by name, such as labels of a segmentation (whole numbers) or
    uncertainties (floats, finite). They are resized with the frame, and reach seeding rules and
    a loss that was given to the mapper; without one, keyframes and checkpoints do not keep
    them."""

    def __init__(
        self,
        *,
        index: int,
        timestamp_s: float,
        depth_m: Tensor | np.ndarray,
        camera: Camera,
        T_WC: Tensor | np.ndarray,
        rgb: Tensor | np.ndarray | None = None,
        colour: Tensor | np.ndarray | None = None,
        extra: "Mapping[str, Tensor | np.ndarray] | None" = None,
    ):
        colour = colour if rgb is None else rgb  # dataclasses.replace(frame, rgb=...) gives both
        given = {"rgb": colour, "depth_m": depth_m, "T_WC": T_WC}
        arrays = {name: x for name, x in given.items() if isinstance(x, np.ndarray)}
        tensors = {
            name: _OF_ARRAY[name](f"{name} of frame {index}", x) for name, x in arrays.items()
        }
        self.__dict__["_conversions"] = tuple(
            f"{name}: numpy.ndarray of {x.dtype} copied to a torch.Tensor of "
            f"{str(tensors[name].dtype).removeprefix('torch.')}"
            for name, x in arrays.items()
        )
        colour, depth_m, T_WC = (given | tensors).values()
        size = (camera.height, camera.width)
        for name, value, shape in (
            ("rgb", colour, (*size, 3)),
            ("depth_m", depth_m, size),
            ("T_WC", T_WC, (4, 4)),
        ):
            types = (torch.float32, torch.uint8) if name == "rgb" else (torch.float32,)
            if not isinstance(value, Tensor) or value.dtype not in types:
                kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
                wanted = " or ".join(str(t).removeprefix("torch.") for t in types)
                raise ArgumentError(
                    f"{name} of frame {index} must be a {wanted} torch.Tensor, got {kind}"
                )
            check_shape(name, value, shape)
        found = _checked_extra(index, extra or {}, size)
        for field, value in zip(
            dataclasses.fields(self),
            (index, timestamp_s, colour, depth_m, camera, T_WC, found),
            strict=True,
        ):
            object.__setattr__(self, field.name, value)

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors, from which ``of_state`` makes the frame again."""
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return parts | {"camera": vars(self.camera), "extra": dict(self.extra)}

    @staticmethod
    def of_state(state: dict[str, Any]) -> "Frame":
        """The frame of which ``state_dict`` gave the values.

        Raises:
            ValueError: a value of the wrong type or shape.
        """
        return Frame(**{**state, "camera": Camera(**state["camera"])})

    @property
    def conversions(self) -> tuple[str, ...]:
        """What was made of the NumPy arrays that were given, a sentence for each: "depth_m:
        numpy.ndarray of float64 copied to a torch.Tensor of float32"."""
        return self.__dict__["_conversions"]

    @property
    def is_8_bit(self) -> bool:
        """Whether colour was given in bytes."""
        return self.colour.dtype == torch.uint8

    @functools.cached_property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colour, 0..1."""
        return rgb_of_bytes(self.colour) if self.is_8_bit else self.colour

    @property
    def rgb_u8(self) -> UInt8[Tensor, "H W 3"]:
        """Colour in grey levels 0..255: the bytes that were given, or floats rounded."""
        if self.is_8_bit:
            return self.colour
        return (self.colour * 255.0).round_().clamp_(0, 255).to(torch.uint8)

    @functools.cached_property
    def T_WC_cpu(self) -> Float[Tensor, "4 4"]:
        """The pose in CPU memory; of a frame that was moved to a GPU, it is known without waiting
        for the GPU."""
        return self.T_WC.detach().cpu()

    def to(self, device: torch.device | str) -> "Frame":
        """The same frame with its tensors on ``device``, contiguous; the frame itself if they are.

        To a GPU they are copied without waiting for it, except from pinned memory, which its owner
        may write to next.
        """
        moved = {
            name: _moved(getattr(self, name), torch.device(device))
            for name in ("colour", "depth_m", "T_WC")
        }
        extra = {name: _moved(value, torch.device(device)) for name, value in self.extra.items()}
        same = [value is getattr(self, name) for name, value in moved.items()]
        if all([*same, *(value is self.extra[name] for name, value in extra.items())]):
            return self
        frame = dataclasses.replace(self, **moved, extra=Extras(extra))
        frame.__dict__["T_WC_cpu"] = self.T_WC_cpu
        return frame


_OF_ARRAY = {"rgb": colour_tensor, "depth_m": depth_tensor, "T_WC": pose_tensor}
"""What makes a tensor of each part of a frame that is given as a NumPy array."""


class Extras(dict[str, Tensor]):
    """``Frame.extra``: an image that is not there is an error that lists those that are."""

    def __missing__(self, name: str) -> Tensor:
        raise UnknownNameError(
            f"this frame has no extra image {name!r}; it has: {', '.join(self) or 'none'}"
        )


def _checked_extra(
    index: int, extra: "Mapping[str, Tensor | np.ndarray]", size: tuple[int, int]
) -> Extras:
    if isinstance(extra, Extras):
        if any(value.shape[:2] != size for value in extra.values()):
            shapes = {name: list(value.shape) for name, value in extra.items()}
            raise ArgumentError(
                f"extra of frame {index} must be [{size[0]}, {size[1]}, ...], got {shapes}"
            )
        return extra
    found = Extras()
    for name, value in extra.items():
        image = (
            torch.from_numpy(np.ascontiguousarray(value))
            if isinstance(value, np.ndarray)
            else value
        )
        if not isinstance(image, Tensor) or image.shape[:2] != size:
            got = list(image.shape) if isinstance(image, Tensor) else type(image).__name__
            raise ArgumentError(
                f"extra {name!r} of frame {index} must be an image [{size[0]}, {size[1]}, ...], "
                f"got {got}"
            )
        if image.is_floating_point() and not bool(image.isfinite().all()):
            raise ArgumentError(
                f"extra {name!r} of frame {index} must be finite, got NaN or infinity; give 0 or a "
                "mask"
            )
        found[name] = image
    return found


def _moved(tensor: Tensor, device: torch.device) -> Tensor:
    uploads = tensor.device.type == "cpu" and device.type == "cuda"
    return tensor.to(device, non_blocking=uploads and not tensor.is_pinned()).contiguous()
