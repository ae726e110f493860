"""Voxels that contain given points, as they are and as a frame will change them.

Cases of ``sample_voxels`` and ``sample_fused_voxels``: points inside and outside of a map, on its
borders, and none; for the second also blocks that are only about to be allocated, and both
distances.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import FusedView, TsdfSample, TsdfVolume, band_blocks, sample_voxels

from . import Case
from .integrate import make_map, wall

_FLIPS = 3e-3
"""Points in voxels that project within rounding of a pixel's border."""


def cases() -> Iterator[Case]:
    """One for each kind of point and map."""
    g = torch.Generator().manual_seed(0)
    spread = 3.0 * torch.rand(500, 3, generator=g) - torch.tensor([1.5, 1.5, 0.5])
    borders = (torch.randint(-40, 40, (200, 3), generator=g) + 0.0) * 0.4
    yield _case("inside and outside", spread)
    yield _case("on borders of blocks", borders)
    yield _case("no points", spread[:0])
    yield _case("an empty map", spread[:7], empty=True)
    near = torch.rand(2000, 3, generator=g) * torch.tensor([2.4, 1.8, 0.9]) - torch.tensor(
        [1.2, 0.9, -1.2]
    )
    for sdf in ("z", "ray"):
        yield _fused(f"{sdf}, old and new blocks", near, sdf=sdf)
    yield _fused("outside of the map", spread)
    yield _fused("no points", near[:0])
    yield _fused("an empty map", near, empty=True)
    yield _fused("nothing new", near, nothing_new=True)
    yield _fused("blocks beyond far_m", near, far_m=1.55)
    yield _fused("average eq9", near, average="eq9")


def _case(name: str, xyz_W: Tensor, *, empty: bool = False) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        with use_backend("reference"):
            volume = make_map([wall()], torch.device("cpu")).to(device)
        volume = TsdfVolume(TsdfConfig(), device) if empty else volume
        return _columns(sample_voxels(volume, xyz_W.to(device)))

    return Case(
        name=name,
        operations=("sample_voxels",),
        run=run,
        dtypes=(torch.float32,),
        tolerance=0.0,
    )


def _fused(
    name: str,
    xyz_W: Tensor,
    *,
    empty: bool = False,
    nothing_new: bool = False,
    **config: Any,
) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        frame = wall(shift_m=0.03)
        with use_backend("reference"):
            volume = make_map([wall()], torch.device("cpu"), **config)
            volume = TsdfVolume(volume.config) if empty else volume
            needed = band_blocks(volume, frame)
        volume = volume.to(device)
        missing = volume.reserve(
            volume.index.missing((needed[:0] if nothing_new else needed).to(device))
        )
        return _columns(
            FusedView(volume, frame.to(device), missing).sample_nearest(xyz_W.to(device))
        )

    return Case(
        name=name,
        operations=("sample_fused_voxels",),
        run=run,
        dtypes=(torch.float32,),
        flips=_FLIPS,
    )


def _columns(sample: TsdfSample) -> dict[str, Tensor]:
    return {"D": sample.D, "W": sample.W, "rgb": sample.rgb, "W_rgb": sample.W_rgb}
