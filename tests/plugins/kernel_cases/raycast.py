"""Surface of the TSDF seen from a camera.

Cases of ``raycast``: the map of a wall from several places, with unobserved voxels, and an empty
map.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf import TsdfVolume, raycast

from . import Case
from .integrate import make_map, wall

_POSES = {
    "from where it was seen": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "from beside and turned": (0.3, -0.1, 0.2, 0.1, -0.2, 0.3),
    "from far away": (0.1, 0.1, -4.0, 0.0, 0.0, 0.0),
    "from behind": (0.05, 0.03, 3.0, 0.0, 3.1, 0.0),
    "from inside": (0.02, 0.01, 1.5, 0.0, 0.4, 0.0),
    "past it": (0.0, 0.0, 9.0, 0.0, 0.0, 0.0),
}


def cases() -> Iterator[Case]:
    """One for each place and state of the map."""
    for name, twist in _POSES.items():
        yield _case(name, twist)
    yield _case("with unobserved voxels", _POSES["from beside and turned"], gaps=True)
    yield _case("an empty map", _POSES["from where it was seen"], empty=True)


def _case(
    name: str,
    twist: tuple[float, ...],
    *,
    gaps: bool = False,
    empty: bool = False,
) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        with use_backend("reference"):
            volume = make_map([wall()], torch.device("cpu")).to(device)
        if gaps:
            volume.W[:, ::7] = 0.0
        if empty:
            volume = TsdfVolume(TsdfConfig(), device)
        camera = wall().camera.resized(24, 18)
        seen = raycast(
            volume,
            camera,
            se3.exp(torch.tensor(twist)).to(device),
        )
        return {"depth_m": seen.depth_m, "normal_W": seen.normal_W, "rgb": seen.rgb}

    # a ray whose step ends within rounding of a surface may take another way
    return Case(
        name=name,
        operations=("raycast",),
        run=run,
        dtypes=(torch.float32,),
        tolerance=1e-4,
        flips=1e-2,
    )
