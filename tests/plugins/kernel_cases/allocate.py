"""Which voxel blocks a frame's depth touches.

Cases of ``band_blocks`` and ``new_band_blocks``: both distances, isolated pixels, nothing measured,
and a camera far from the origin.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf import TsdfVolume, band_blocks, new_band_blocks
from gsfusion_nb.tsdf.morton import encode
from gsfusion_nb.types import Frame

from . import Case, make_frame

_REACH = 24
"""Blocks on each side of the camera's own that the result shows."""


def cases() -> Iterator[Case]:
    """One for each way in which the marked blocks come about."""
    ways: tuple[tuple[str, dict[str, Any], dict[str, Any]], ...] = (
        ("along z", {}, {"sdf": "z"}),
        ("along the ray", {}, {"sdf": "ray"}),
        ("isolated pixels", {"isolated": True}, {}),
        ("isolated pixels, no guard", {"isolated": True}, {"outlier_guard": False}),
        ("a long band", {}, {"truncation_voxels": 20.0}),
        ("nothing measured", {"depth_m": 0.0}, {}),
        ("640 m from the origin", {"offset_m": 640.0}, {}),
    )
    for name, change, config in ways:

        def run(
            device: torch.device, dtype: torch.dtype, change=change, config=config
        ) -> dict[str, Tensor]:
            frame = _frame(**change).to(device)
            volume = TsdfVolume(
                TsdfConfig(**{"voxel_size_m": 0.02, "truncation_voxels": 4.0, **config}), device
            )
            return {"marked": _marked(band_blocks(volume, frame), volume, frame)}

        yield Case(
            name=name,
            operations=("band_blocks",),
            run=run,
            dtypes=(torch.float32,),
            flips=1e-4,
        )
        for known in ("none", "some", "all", "far apart"):
            run_new = functools.partial(_run_new, known=known, change=change, config=config)
            named = f"{name}, {known} known"
            yield Case(
                name=named,
                operations=("new_band_blocks",),
                run=run_new,
                dtypes=(torch.float32,),
                flips=1e-4,
            )


def _run_new(
    device: torch.device,
    dtype: torch.dtype,
    *,
    known: str,
    change: dict[str, Any],
    config: dict[str, Any],
) -> dict[str, Tensor]:
    """``known``: which of the blocks exist already; far apart: in a map that is too large for a
    table."""
    frame = _frame(**change)
    volume = TsdfVolume(TsdfConfig(**{"voxel_size_m": 0.02, "truncation_voxels": 4.0, **config}))
    with use_backend("reference"):
        blocks = band_blocks(volume, frame)
    if known != "none":
        volume.add_blocks(blocks if known == "all" else blocks[::2])
    if known == "far apart":
        volume.add_blocks(torch.tensor([[-100_000, 0, 0], [100_000, 7, 90_000]]))
    frame = frame.to(device)
    volume = volume.to(device)
    new = new_band_blocks(volume, frame)
    inside = (new.coords >= torch.tensor(new.low, device=device)) & (
        new.coords <= torch.tensor(new.high, device=device)
    )
    return {
        "marked": _marked(new.coords, volume, frame),
        "codes that do not fit": (new.codes != encode(new.coords)).sum(),
        "codes out of order": (new.codes.diff() <= 0).sum(),
        "outside the box": (~inside).sum(),
    }


def _frame(
    *,
    isolated: bool = False,
    depth_m: float | None = None,
    offset_m: float = 0.0,
) -> Frame:
    frame = make_frame()
    depth = frame.depth_m.clone() if depth_m is None else torch.full_like(frame.depth_m, depth_m)
    if isolated:
        depth[::9, ::7] = 0.7
    # no wall of a block along an axis of the image
    T_WC = se3.exp(torch.tensor([0.11, -0.23, 0.31, 0.2, -0.3, 0.1]))
    T_WC[:3, 3] += offset_m
    return dataclasses.replace(frame, depth_m=depth, T_WC=T_WC)


def _marked(blocks: Tensor, volume: TsdfVolume, frame: Frame) -> Tensor:
    """Which blocks around the camera were found; a block that a ray touches to rounding is one
    element."""
    own = (frame.T_WC[:3, 3].double() / volume.block_size_m).floor().long()
    marked = torch.zeros([2 * _REACH + 1] * 3, device=blocks.device)
    marked[tuple((blocks - own + _REACH).unbind(1))] = 1.0
    return marked
