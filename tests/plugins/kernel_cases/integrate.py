"""Update of the TSDF from one frame.

Cases of ``fuse_frame_``: both distances, colours as bytes and between them, and views of which some
see nothing.
"""

import dataclasses
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.tsdf.integrate import fuse_frame_
from gsfusion_nb.types import Frame

from . import Case, make_frame

_POSE = se3.exp(torch.tensor([0.013, -0.021, 0.017, 0.02, -0.03, 0.05]))
"""A camera along the axes of the world would see rows of voxels exactly on the borders of its
pixels."""

_FLIPS = 2e-4
"""Voxels that project within rounding of a pixel's border."""


def cases() -> Iterator[Case]:
    """Two frames one after the other, the second from 3 cm beside."""
    for sdf in ("z", "ray"):
        for whole_numbers, colours in ((True, "8-bit"), (False, "float")):
            frames = [wall(whole_numbers=whole_numbers, shift_m=x) for x in (0.0, 0.03)]
            yield _case(f"{sdf}, {colours} colours", frames, sdf=sdf)
    for average, flips in (
        ("eq9", _FLIPS),
        ("int16", 2e-2),
    ):  # a last bit decides between two whole numbers
        frames = [wall(shift_m=x) for x in (0.0, 0.03, 0.01)]
        yield _case(f"average {average}", frames, flips=flips, average=average)
    for band, by_distance, weights in (
        (0.0, False, "falling"),
        (0.0, True, "falling"),
        (0.5, False, "falling"),
        (0.5, True, "equal"),
    ):
        frames = [wall(shift_m=x) for x in (0.0, 0.03, 0.01)]
        name = f"band of colours {band:g}, {weights}{', by distance' if by_distance else ''}"
        colours = {
            "colour_band_voxels": band,
            "colour_by_distance": by_distance,
            "colour_weights": weights,
        }
        yield _case(name, frames, **colours)
    frame = wall()
    yield _case(
        "nothing measured",
        [frame, dataclasses.replace(frame, depth_m=torch.zeros_like(frame.depth_m))],
    )
    yield _case("a camera inside the map", [_moved(frame, z=1.4)])
    yield _case("nothing in view", [_moved(frame, z=9.0)])
    yield _case(
        "blocks beyond far_m", [dataclasses.replace(frame, depth_m=10 * frame.depth_m)], far_m=1.0
    )
    yield _case("a low cap on the weight", [frame] * 3, max_weight=2.0)


def wall(*, whole_numbers: bool = True, shift_m: float = 0.0) -> Frame:
    """The wall of ``make_frame``, seen with a camera that is turned a little."""
    frame = make_frame(whole_numbers=whole_numbers, shift_m=shift_m)
    return dataclasses.replace(frame, T_WC=_POSE @ frame.T_WC)


def make_map(frames: list[Frame], device: torch.device, **config) -> TsdfVolume:
    """What ``frames`` make of the blocks between 1 and 2 m in front of the first camera of
    ``wall``."""
    volume = TsdfVolume(
        TsdfConfig(**{"voxel_size_m": 0.05, "truncation_voxels": 2.0, **config}), device
    )
    axes = [torch.arange(-3, 3), torch.arange(-2, 2), torch.arange(2, 5)]
    volume.add_blocks(
        torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).view(-1, 3).to(device)
    )
    for frame in frames:
        fuse_frame_(volume, frame.to(device))
    return volume


def _case(
    name: str,
    frames: list[Frame],
    flips: float = _FLIPS,
    **config,
) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        volume = make_map(frames, device, **config)
        return {"D": volume.D, "W": volume.W, "rgb": volume.rgb_planes, "W_rgb": volume.W_rgb}

    return Case(
        name=name,
        operations=("fuse_frame_",),
        run=run,
        dtypes=(torch.float32,),
        flips=flips,
    )


def _moved(frame: Frame, *, z: float) -> Frame:
    T_WC = frame.T_WC.clone()
    T_WC[2, 3] = z
    return dataclasses.replace(frame, T_WC=T_WC)
