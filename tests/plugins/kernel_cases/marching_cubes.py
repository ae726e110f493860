"""Triangle mesh of the TSDF's zero level.

Cases of ``extract_mesh``: the map of a wall, every case of the triangle table, and maps without a
surface.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, extract_mesh

from . import Case
from .integrate import make_map, wall


def cases() -> Iterator[Case]:
    """One for each map."""
    yield _case("a wall", _wall)
    yield _case("a wall, seen twice", _wall, min_weight=2.0)
    yield _case("a wall, seen more often than it was", _wall, min_weight=9.0)
    yield _case("random signs", lambda: _noise(missing=0.0))
    yield _case("random signs, voxels missing", lambda: _noise(missing=0.1))
    yield _case("an empty map", lambda: TsdfVolume(TsdfConfig()))


def _case(name: str, make, *, min_weight: float = 1.0) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        with use_backend("reference"):
            volume = make().to(device)
        mesh = extract_mesh(volume, min_weight=min_weight)
        return {"vertices_W": mesh.vertices_W, "faces": mesh.faces, "rgb": mesh.rgb}

    return Case(
        name=name,
        operations=("extract_mesh",),
        run=run,
        dtypes=(torch.float32,),
        tolerance=1e-6,
    )


def _wall() -> TsdfVolume:
    return make_map([wall(), wall(shift_m=0.03)], torch.device("cpu"))


def _noise(*, missing: float) -> TsdfVolume:
    """All 256 cases, across every kind of border between blocks; every fourth block is not
    there."""
    g = torch.Generator().manual_seed(0)
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05))
    axis = torch.arange(-1, 2)
    coords = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    volume.add_blocks(coords[torch.arange(27) % 4 > 0])
    volume.D[:] = 2.0 * torch.rand(volume.D.shape, generator=g) - 1.0
    volume.W[:] = (torch.rand(volume.W.shape, generator=g) >= missing).float()
    volume.rgb_planes[:] = torch.rand(volume.rgb_planes.shape, generator=g)
    return volume
