"""Which chunks of a large map a view may show.

Cases of ``chunks_shown``: boxes before, beside and behind the camera, large and small, one with
NaN, and none; with and without measured depth, of which parts are missing.
"""

import functools
import itertools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry import se3
from gsfusion_nb.large_maps.chunks import Chunks, chunks_shown, farthest_depth

from . import Case, make_frame


def cases() -> Iterator[Case]:
    """One for each number of chunks, with and without depth."""
    for n, with_depth in itertools.product((0, 1, 3000), (False, True)):
        yield Case(
            name=f"{n} chunks, {'with' if with_depth else 'without'} depth",
            operations=("chunks_shown",),
            run=functools.partial(_run, n, with_depth),
            dtypes=(torch.float32,),
        )


def _run(n: int, with_depth: bool, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    middle = 8.0 * torch.rand(n, 3, generator=g) - torch.tensor([4.0, 4.0, 2.0])
    half = torch.rand(n, 1, generator=g) ** 3 * torch.rand(n, 3, generator=g)
    low = (middle - half).numpy()
    high = (middle + half).numpy()
    reach_m = (0.5 * torch.rand(n, generator=g) ** 2).numpy()
    if n > 1:
        low[7] = high[7] = float("nan")
    frame = make_frame()
    depth_m = frame.depth_m.clone()
    depth_m[:20, 30:] = 0.0
    T_WC = frame.T_WC.double() @ se3.exp(torch.tensor([0.1, -0.2, 0.1, 0.2, 0.3, -0.1]).double())
    is_shown = chunks_shown(
        Chunks(low, high, reach_m),
        frame.camera,
        se3.inverse(T_WC).numpy(),
        farthest_depth(depth_m).numpy() if with_depth else None,
    )
    return {"is_shown": torch.from_numpy(is_shown)}
