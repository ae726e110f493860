"""The views that are revisited while mapping and optimised over after the scan."""

import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from ..backends import piece
from ..large_maps import farthest_depth
from ..resources import MAP_MEMORY
from ..types import Camera, Extras, Frame, GaussianParams, rgb_of_bytes

IN_MEMORY_BYTES = 1 << 30
"""Images of keyframes beyond these are in temporary files, of whose pages the system keeps what
memory allows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Keyframe:
    """A view to optimise against. Its image is stored as bytes, a quarter of float32, shared with
    an 8-bit frame."""

    index: int
    rgb_u8: UInt8[Tensor, "H W 3"]
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    depth_m: Float[Tensor, "H W"] | None = None
    """z-depth, metres; None if the mapper has no depth loss."""
    exposure: Float[Tensor, " 3"] | None = None
    """The factor of each colour between the map's picture and this one; None is 1."""
    farthest_m: Float[Tensor, "12 16"] | None = None
    """Largest depth in parts of the image (``gsfusion_nb.large_maps.farthest_depth``)."""
    extra: Mapping[str, Shaped[Tensor, "H W *C"]] = field(default_factory=Extras)
    """Further images (``Frame.extra``); none if the mapper has its own loss, which asks for
    none."""

    @classmethod
    def of(cls, frame: Frame, *, with_depth: bool = False, with_extra: bool = False) -> "Keyframe":
        """The view of a frame, with its depth if ``with_depth``, and further images if
        ``with_extra``."""
        return cls(
            index=frame.index,
            rgb_u8=frame.rgb_u8,
            camera=frame.camera,
            T_WC=frame.T_WC,
            depth_m=frame.depth_m if with_depth else None,
            farthest_m=farthest_depth(frame.depth_m),
            extra=frame.extra if with_extra else Extras(),
        )

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colour, 0..1, made from bytes at each access: a step asks once."""
        return rgb_of_bytes(self.rgb_u8)

    def state_dict(self) -> dict[str, Any]:
        """Plain values; files call the exposure "gain"."""
        values = vars(self) | {"camera": vars(self.camera), "extra": dict(self.extra)}
        if not self.extra:
            values.pop("extra")
        return {"gain" if name == "exposure" else name: x for name, x in values.items()}

    @staticmethod
    def from_state_dict(state: dict[str, Any]) -> "Keyframe":
        """The keyframe that was saved with ``state_dict``."""
        values = {"exposure" if name == "gain" else name: x for name, x in state.items()}
        extra = Extras(state.get("extra", {}))
        return Keyframe(**{**values, "camera": Camera(**state["camera"]), "extra": extra})

    def to(self, device: torch.device | str) -> "Keyframe":
        """The same keyframe with its tensors on ``device``; the keyframe itself if they are."""
        images = {name: x.to(device) for name, x in vars(self).items() if isinstance(x, Tensor)}
        extra = Extras({name: x.to(device) for name, x in self.extra.items()})
        if all(value is getattr(self, name) for name, value in images.items()) and all(
            value is self.extra[name] for name, value in extra.items()
        ):
            return self
        return dataclasses.replace(self, **images, extra=extra)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingView:
    """An RGB-D image to optimise against, and the pixels of it that are used."""

    rgb: Float[Tensor, "H W 3"]
    """Colour, 0..1."""
    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where missing."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    pixels: Bool[Tensor, "H W"]
    """Those that count."""
    index: int = -1
    """Number of its frame; -1 if not known."""
    extra: Mapping[str, Shaped[Tensor, "H W *C"]] = field(default_factory=Extras)
    """Further images of the frame, such as labels (``Frame.extra``)."""
    params: GaussianParams | None = None
    """The Gaussians that the step changes, R rows; what it only draws (RTG-SLAM) is not among
    them. Filled where a loss is asked."""

    @staticmethod
    def of(
        source: Frame | Keyframe,
        pixels: Bool[Tensor, "H W"] | None = None,
        rgb: Float[Tensor, "H W 3"] | None = None,
    ) -> "TrainingView":
        """The view of a frame or keyframe; all pixels by default.

        Args:
            source: The frame or keyframe.
            pixels: Those that count.
            rgb: ``source.rgb``, where it was asked before.
        """
        rgb = source.rgb if rgb is None else rgb
        depth_m = source.depth_m
        if depth_m is None:
            depth_m = torch.zeros(rgb.shape[:2], device=rgb.device)
        all_pixels = torch.ones_like(depth_m, dtype=torch.bool)
        return TrainingView(
            rgb=rgb,
            depth_m=depth_m,
            camera=source.camera,
            T_WC=source.T_WC,
            pixels=all_pixels if pixels is None else pixels,
            index=source.index,
            extra=source.extra,
        )


class KeyframeList:
    """Keyframes in the order in which they were added; random numbers come only from the generator
    that is passed in.

    Args:
        device: Device on which the images are stored; by default that of the frames. On a processor
            they take no more than ``IN_MEMORY_BYTES``, and the others are read from temporary files
            when they are used.
    """

    def __init__(self, device: torch.device | str | None = None):
        self.device = device
        self._items: list[Keyframe] = []
        self._bytes_kept = 0
        self._poses = torch.zeros(0, 4, 4)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, i: int) -> Keyframe:
        return self._items[i]

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._items)

    @property
    def T_WC(self) -> Float[Tensor, "K 4 4"]:
        """Their camera-to-world poses, on the CPU."""
        # keyframes were added, or all poses may have changed
        if len(self._poses) < len(self._items):
            self._poses = torch.cat(
                [self._poses, *(k.T_WC.cpu()[None] for k in self._items[len(self._poses) :])]
            )
        return self._poses

    def append(self, frame: Frame, *, with_depth: bool = False, with_extra: bool = False) -> None:
        """Add ``frame`` as a keyframe, with its depth if ``with_depth``, and further images if
        ``with_extra``."""
        self._keep(Keyframe.of(frame, with_depth=with_depth, with_extra=with_extra))

    def snapshot(self) -> tuple[list[Keyframe], int]:
        """The keyframes of now, for ``restore``; a keyframe itself never changes."""
        return list(self._items), self._bytes_kept

    def restore(self, snapshot: tuple[list[Keyframe], int]) -> None:
        """Go back to the keyframes of a ``snapshot``."""
        items, self._bytes_kept = snapshot
        self._items = list(items)
        self._poses = self._poses[:0]

    def move(self, T: Float[Tensor, "K 4 4"]) -> None:
        """Apply a rigid motion to each keyframe's pose (a loop closure)."""
        self._items = [
            dataclasses.replace(k, T_WC=T_k.to(k.T_WC) @ k.T_WC)
            for k, T_k in zip(self._items, T, strict=True)
        ]
        self._poses = self._poses[:0]

    def set_pose(self, index: int, T_WC: Float[Tensor, "4 4"]) -> None:
        """Give the keyframe of the frame with this index another pose."""
        at = self._place(index)
        self._items[at] = dataclasses.replace(
            self._items[at],
            T_WC=T_WC.to(self._items[at].T_WC),
        )
        self._poses = self._poses[:at]

    def set_exposure(self, index: int, exposure: Float[Tensor, " 3"]) -> None:
        """Give the keyframe of the frame with this index another exposure."""
        at = self._place(index)
        self._items[at] = dataclasses.replace(
            self._items[at], exposure=exposure.to(self._items[at].T_WC.device)
        )

    def _place(self, index: int) -> int:
        return next(i for i, k in enumerate(self._items) if k.index == index)

    def drop(self, is_dropped: Callable[[Keyframe], bool]) -> int:
        """Remove the keyframes for which this is true; returns their number."""
        dropped_items = [k for k in self._items if is_dropped(k)]
        dropped = {id(k) for k in dropped_items}
        self._items = [k for k in self._items if id(k) not in dropped]
        self._poses = self._poses[:0]
        for k in dropped_items:
            self._bytes_kept -= k.rgb_u8.nbytes + (0 if k.depth_m is None else k.depth_m.nbytes)
        return len(dropped_items)

    def draw(self, count: int, generator: torch.Generator) -> list[Keyframe]:
        """Up to ``count`` different keyframes at random (GSFusion III-B.3: the first of the
        shuffled list)."""
        if count == 0 or not self._items:
            return []
        return [self._items[i] for i in draw_keyframes(len(self._items), count, generator).tolist()]

    def state_dict(self) -> list[dict[str, Any]]:
        """Plain values of every keyframe."""
        return [k.state_dict() for k in self._items]

    @classmethod
    def from_state_dict(
        cls,
        state: list[dict[str, Any]],
        device: torch.device | str | None = None,
    ) -> "KeyframeList":
        """The list that was saved with ``state_dict``, with its images on ``device`` if one is
        given."""
        keyframes = cls(device)
        for s in state:
            keyframes._keep(Keyframe.from_state_dict(s))
        return keyframes

    def _keep(self, keyframe: Keyframe) -> None:
        keyframe = keyframe if self.device is None else keyframe.to(self.device)
        images = {
            name: x for name in ("rgb_u8", "depth_m") if (x := getattr(keyframe, name)) is not None
        }
        extra = keyframe.extra
        self._bytes_kept += sum(image.nbytes for image in (*images.values(), *extra.values()))
        device = keyframe.rgb_u8.device
        is_full = (
            self._bytes_kept > IN_MEMORY_BYTES and device.type == "cpu" and sys.platform != "win32"
        )
        if is_full or MAP_MEMORY.is_in_files(device):
            keyframe = dataclasses.replace(
                keyframe,
                **{name: MAP_MEMORY.in_file(x) for name, x in images.items()},
                extra=Extras({name: MAP_MEMORY.in_file(x) for name, x in extra.items()}),
            )
        self._items.append(keyframe)


@piece
def draw_keyframes(
    n_keyframes: int,
    count: int,
    generator: torch.Generator,
) -> Int[Tensor, " M"]:
    """Numbers of up to ``count`` different keyframes at random, all with the same chance (GSFusion
    III-B.3)."""
    return torch.randperm(n_keyframes, generator=generator)[:count]
