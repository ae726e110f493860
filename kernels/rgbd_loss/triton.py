"""RTG-SLAM's loss and its gradient in two passes over the image: count, then write.

The second pass takes the counts from the device; the host waits for nothing.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.optim.rgbd_loss import RgbdLoss
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp as reference

from ..runtime.triton.launch import device_of, launch, parts
from .host import is_float32, limit_m, to_loss

_BLOCK = 1024


def rgbd_l1_vjp(
    rgb: Tensor,
    depth_m: Tensor,
    target_rgb: Tensor,
    target_depth_m: Tensor,
    pixels: Tensor,
    *,
    weight_colour: float = 1.0,
    weight_depth: float = 1.0,
    behind_m: float | None = None,
) -> RgbdLoss:
    """See ``gsfusion_nb.optim.rgbd_l1_vjp``."""
    images = (rgb, depth_m, target_rgb, target_depth_m)
    if not is_float32(*images):
        options = {"weight_colour": weight_colour, "weight_depth": weight_depth, "behind_m": behind_m}
        return reference.reference(*images, pixels, **options)
    names = ("rgb", "depth_m", "target_rgb", "target_depth_m")
    device = device_of("rgbd_l1_vjp", **dict(zip(names, images, strict=True)), pixels=pixels)
    arrays = [*(image.detach().contiguous() for image in images), pixels.contiguous().view(torch.uint8)]
    v_rgb, v_depth_m = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in (rgb, depth_m))
    total, limit = depth_m.numel(), limit_m(behind_m)
    sums = torch.zeros(parts(total, _BLOCK), 4, dtype=torch.float32, device=device)
    launch(_sums, len(sums), device, *arrays, sums, total, limit, BLOCK=_BLOCK, num_warps=4)
    sums = sums.sum(0, dtype=torch.float64)
    counts = sums[:2].clamp_min(1.0)
    launch(
        _write, parts(total, _BLOCK), device, *arrays, counts, v_rgb, v_depth_m, total, limit,
        float(weight_colour), float(weight_depth), BLOCK=_BLOCK, num_warps=4,
    )  # fmt: skip
    colour, depth = (sums[2:] / counts).float()
    return to_loss(torch.stack([colour, depth, weight_colour * colour + weight_depth * depth]), v_rgb, v_depth_m)


@triton.jit
def _gaps(rgb, depth, target_rgb, target_depth, pixels, at, total, limit):
    """Differences of the three colours and of the depth, and which pixels count for either; 0 where not."""
    here = at < total
    wanted = here & (tl.load(pixels + at, mask=here, other=0) != 0)
    red = tl.load(rgb + 3 * at, mask=wanted, other=0.0) - tl.load(target_rgb + 3 * at, mask=wanted, other=0.0)
    green = tl.load(rgb + 3 * at + 1, mask=wanted, other=0.0) - tl.load(target_rgb + 3 * at + 1, mask=wanted, other=0.0)
    blue = tl.load(rgb + 3 * at + 2, mask=wanted, other=0.0) - tl.load(target_rgb + 3 * at + 2, mask=wanted, other=0.0)
    d, target = tl.load(depth + at, mask=wanted, other=0.0), tl.load(target_depth + at, mask=wanted, other=0.0)
    known = wanted & (d > 0) & (target > 0) & (d - target < limit)
    return red, green, blue, tl.where(known, d - target, 0.0), wanted, known


@triton.jit
def _sign(x):
    return tl.where(x > 0, 1.0, tl.where(x < 0, -1.0, 0.0))


@triton.jit(do_not_specialize=["total", "limit"])
def _sums(rgb, depth, target_rgb, target_depth, pixels, sums, total, limit, BLOCK: tl.constexpr):
    """Colour values, pixels with a depth loss, sum |C - C^|, sum |D - D^| of each program."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    r, g, b, d, wanted, known = _gaps(rgb, depth, target_rgb, target_depth, pixels, at, total, limit)
    out = sums + 4 * tl.program_id(0)
    tl.store(out, 3.0 * tl.sum(wanted.to(tl.float32), axis=0))
    tl.store(out + 1, tl.sum(known.to(tl.float32), axis=0))
    tl.store(out + 2, tl.sum(tl.abs(r) + tl.abs(g) + tl.abs(b), axis=0))
    tl.store(out + 3, tl.sum(tl.abs(d), axis=0))


@triton.jit(do_not_specialize=["total", "limit", "weight_colour", "weight_depth"])
def _write(
    rgb, depth, target_rgb, target_depth, pixels, counts, v_rgb, v_depth, total, limit, weight_colour, weight_depth,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The two gradient images; every pixel is written."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < total
    r, g, b, d, _, _ = _gaps(rgb, depth, target_rgb, target_depth, pixels, at, total, limit)
    scale = weight_colour / tl.load(counts).to(tl.float32)
    tl.store(v_rgb + 3 * at, _sign(r) * scale, mask=here)
    tl.store(v_rgb + 3 * at + 1, _sign(g) * scale, mask=here)
    tl.store(v_rgb + 3 * at + 2, _sign(b) * scale, mask=here)
    tl.store(v_depth + at, _sign(d) * (weight_depth / tl.load(counts + 1).to(tl.float32)), mask=here)
