"""Cases of ``sample_voxels``: points inside and outside of a map, on its borders, and none."""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, sample_voxels

from ..integrate.cases import make_map, wall
from ..runtime.cases import Case


def cases() -> Iterator[Case]:
    """One for each kind of point and map."""
    g = torch.Generator().manual_seed(0)
    spread = 3.0 * torch.rand(500, 3, generator=g) - torch.tensor([1.5, 1.5, 0.5])
    borders = (torch.randint(-40, 40, (200, 3), generator=g) + 0.0) * 0.4
    yield _case("inside and outside", spread)
    yield _case("on borders of blocks", borders)
    yield _case("no points", spread[:0])
    yield _case("an empty map", spread[:7], empty=True)


def _case(name: str, xyz_W: Tensor, *, empty: bool = False) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        with use_backend("reference"):
            volume = make_map([wall()], torch.device("cpu")).to(device)
        volume = TsdfVolume(TsdfConfig(), device) if empty else volume
        sample = sample_voxels(volume, xyz_W.to(device))
        return {"D": sample.D, "W": sample.W, "rgb": sample.rgb}

    return Case(name=name, operations=("sample_voxels",), run=run, dtypes=(torch.float32,), tolerance=0.0)
