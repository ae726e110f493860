"""Cases of ``adam_update``: every way of counting steps, on parameters of every shape."""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import adam_update

from ..runtime.cases import Case

_SHAPES = ((0, 3), (1,), (7, 3), (2100, 16, 3))


def cases() -> Iterator[Case]:
    """One for each kind of step count, and one for the rows in use of a map's buffer."""
    for steps in ("none", "shared", "per_row"):

        def run(device: torch.device, dtype: torch.dtype, steps: str = steps) -> dict[str, Tensor]:
            results = {}
            for shape in _SHAPES:
                size = "x".join(map(str, shape))
                updated = _three_updates(shape, steps, device, dtype)
                results |= {f"{name} {size}": value for name, value in updated.items()}
            return results

        yield Case(name=f"step count {steps!r}", operations=("adam_update",), run=run)
    yield Case(name="rows of a larger buffer", operations=("adam_update",), run=_part_of_a_buffer)


def _three_updates(shape: tuple[int, ...], steps: str, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    gradients = torch.randn(3, *shape, generator=g).to(device, dtype)
    lr = torch.rand(shape[1:], generator=g).to(device, dtype) if len(shape) > 1 else 0.1
    param, exp_avg, exp_avg_sq = (torch.full(shape, x, device=device, dtype=dtype) for x in (1.0, 0.0, 0.0))
    for t, gradient in enumerate(gradients, start=1):
        rows = torch.arange(len(param), dtype=torch.int32, device=device) % 5 + t
        counts = {"none": None, "shared": t, "per_row": rows}
        adam_update(param, gradient, exp_avg, exp_avg_sq, counts[steps], lr=lr, beta1=0.9, beta2=0.999, eps=1e-15)
    return {"param": param, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}


def _part_of_a_buffer(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """The other rows stay as they are; a gradient may have gaps."""
    buffer, exp_avg, exp_avg_sq = (torch.zeros(10, 3, device=device, dtype=dtype) for _ in range(3))
    gradient = torch.arange(24.0, device=device, dtype=dtype).view(4, 6) - 7
    for g in (gradient[:, :3].contiguous(), gradient[:, ::2]):
        adam_update(buffer[:4], g, exp_avg[:4], exp_avg_sq[:4], None, lr=1.0, beta1=0.9, beta2=0.999, eps=1e-15)
    return {"buffer": buffer, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
