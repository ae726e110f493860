"""Faults of recordings as changes of frames that are right: what a run must notice of them."""

import dataclasses
from collections.abc import Callable, Sequence

import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.types import Frame

Change = Callable[[Sequence[Frame]], list[Frame]]


def _posed(change: Callable[[torch.Tensor], torch.Tensor]) -> Change:
    return lambda frames: [
        dataclasses.replace(f, T_WC=change(f.T_WC.double()).float()) for f in frames
    ]


def _seen_by(change: Callable[[dict[str, float]], dict[str, float]]) -> Change:
    def changed(frames: Sequence[Frame]) -> list[Frame]:
        cameras = [dataclasses.replace(f.camera, **change(vars(f.camera))) for f in frames]
        return [dataclasses.replace(f, camera=c) for f, c in zip(frames, cameras, strict=True)]

    return changed


def _depth_times(factor: float) -> Change:
    return lambda frames: [dataclasses.replace(f, depth_m=f.depth_m * factor) for f in frames]


def _in_another_order(*names: str) -> Change:
    """Images of frames that are not neighbours: each ninth of a recording, or of a dozen each
    fifth."""

    def changed(frames: Sequence[Frame]) -> list[Frame]:
        n = len(frames)
        step = next(k for k in (9, 5, 7, 11, 13) if n % k)
        others = [frames[(i * step + 3) % n] for i in range(n)]
        parts = [{name: getattr(other, name) for name in names} for other in others]
        return [dataclasses.replace(f, **part) for f, part in zip(frames, parts, strict=True)]

    return changed


def _jump(frames: Sequence[Frame]) -> list[Frame]:
    """From the seventh frame on the path goes on 1.7 m away."""
    away = torch.eye(4)
    away[:3, 3] = torch.tensor([1.0, -0.95, 1.0])
    return [*frames[:6], *(dataclasses.replace(f, T_WC=away @ f.T_WC) for f in frames[6:])]


def repeats(*names: str) -> Change:
    """Three frames have these images of the one before them."""

    def changed(frames: Sequence[Frame]) -> list[Frame]:
        same = {name: getattr(frames[5], name) for name in names}
        return [
            dataclasses.replace(f, **same) if i in (6, 7, 8) else f for i, f in enumerate(frames)
        ]

    return changed


FAULTS: dict[str, tuple[Change, str]] = {
    "world-to-camera poses": (_posed(se3.inverse), "with inverted poses"),
    "axes of OpenGL": (
        _posed(lambda T: T @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))),
        "with the camera axes of opengl",
    ),
    "focal length 1.5 times too long": (
        _seen_by(lambda c: {"fx": 1.5 * c["fx"], "fy": 1.5 * c["fy"]}),
        "with focal lengths 0.",
    ),
    "focal length 1.5 times too short": (
        _seen_by(lambda c: {"fx": c["fx"] / 1.5, "fy": c["fy"] / 1.5}),
        "with focal lengths 1.",
    ),
    "principal point a quarter to the right": (
        _seen_by(lambda c: {"cx": c["cx"] + 0.25 * c["width"]}),
        "with the principal point in the middle",
    ),
    "principal point a quarter too low": (
        _seen_by(lambda c: {"cy": c["cy"] + 0.25 * c["width"]}),
        "with the principal point in the middle",
    ),
    "depth five times too far": (_depth_times(5.0), "with depth 0.2 times as large"),
    "depth five times too near": (_depth_times(0.2), "with depth 5 times as large"),
    "shuffled depth": (_in_another_order("depth_m"), ""),
    "shuffled colour": (_in_another_order("colour"), "their pictures do not follow"),
    "a jump of 1.7 m": (_jump, "the pose jumps by 1."),
    "three repeated frames": (repeats("colour", "depth_m"), "has the colour and depth of frame"),
    "three repeated depth images": (repeats("depth_m"), "has the depth of frame"),
}
"""Fault -> the change, and words of what is said of it."""
