"""RTG-SLAM's loss and its gradient in two passes over the image: count, then write.

The second pass takes the counts from the device; the host waits for nothing.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.optim.rgbd_loss import RgbdLoss
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp as reference

from ..runtime.triton.launch import device_of, launch, load3, parts, store3

_BLOCK = 1024
_COLOUR_VALUES, _DEPTH_PIXELS, _COLOUR_SUM, _DEPTH_SUM = (tl.constexpr(n) for n in range(4))
"""What the kernels add up: values of colour and pixels with a depth loss, then sum |C - C^| and sum
|D - D^|."""
_N_SUMS = tl.constexpr(4)


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
    if any(image.dtype != torch.float32 for image in images):
        options = {
            "weight_colour": weight_colour,
            "weight_depth": weight_depth,
            "behind_m": behind_m,
        }
        return reference.reference(*images, pixels, **options)
    names = ("rgb", "depth_m", "target_rgb", "target_depth_m")
    device = device_of("rgbd_l1_vjp", rgb)
    v_rgb, v_depth_m = (
        torch.empty_like(t, memory_format=torch.contiguous_format) for t in (rgb, depth_m)
    )
    total = depth_m.numel()
    shared = {
        **{name: image.detach().contiguous() for name, image in zip(names, images, strict=True)},
        "pixels": pixels.contiguous().view(torch.uint8),
        "total": total,
        "limit": float("inf") if behind_m is None else float(behind_m),
        "BLOCK": _BLOCK,
        "num_warps": 4,
    }
    sums = torch.zeros(parts(total, _BLOCK), _N_SUMS.value, dtype=torch.float32, device=device)
    launch(_sums, len(sums), device, sums=sums, **shared)
    sums = sums.sum(0, dtype=torch.float64)
    counts = sums[: _COLOUR_SUM.value].clamp_min(1.0)
    launch(
        _write,
        parts(total, _BLOCK),
        device,
        counts=counts,
        v_rgb=v_rgb,
        v_depth=v_depth_m,
        weight_colour=float(weight_colour),
        weight_depth=float(weight_depth),
        **shared,
    )
    colour, depth = (sums[_COLOUR_SUM.value :] / counts).float()
    loss = weight_colour * colour + weight_depth * depth
    return RgbdLoss(colour=colour, depth_m=depth, total=loss, v_rgb=v_rgb, v_depth_m=v_depth_m)


@triton.jit
def _gaps(rgb, depth_m, target_rgb, target_depth_m, pixels, at, total, limit):
    """Differences of the three colours and of the depth, and which pixels count for either; 0 where
    not."""
    here = at < total
    wanted = here & (tl.load(pixels + at, mask=here, other=0) != 0)
    r, g, b = load3(rgb, at, wanted)
    target_r, target_g, target_b = load3(target_rgb, at, wanted)
    d = tl.load(depth_m + at, mask=wanted, other=0.0)
    target = tl.load(target_depth_m + at, mask=wanted, other=0.0)
    known = wanted & (d > 0) & (target > 0) & (d - target < limit)
    return r - target_r, g - target_g, b - target_b, tl.where(known, d - target, 0.0), wanted, known


@triton.jit
def _sign(x):
    return tl.where(x > 0, 1.0, tl.where(x < 0, -1.0, 0.0))


@triton.jit(do_not_specialize=["total", "limit"])
def _sums(
    rgb, depth_m, target_rgb, target_depth_m, pixels, sums, total, limit, BLOCK: tl.constexpr
):
    """The four sums, of each program."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    r, g, b, d, wanted, known = _gaps(
        rgb, depth_m, target_rgb, target_depth_m, pixels, at, total, limit
    )
    out = sums + _N_SUMS * tl.program_id(0)
    tl.store(out + _COLOUR_VALUES, 3.0 * tl.sum(wanted.to(tl.float32), axis=0))
    tl.store(out + _DEPTH_PIXELS, tl.sum(known.to(tl.float32), axis=0))
    tl.store(out + _COLOUR_SUM, tl.sum(tl.abs(r) + tl.abs(g) + tl.abs(b), axis=0))
    tl.store(out + _DEPTH_SUM, tl.sum(tl.abs(d), axis=0))


@triton.jit(do_not_specialize=["total", "limit", "weight_colour", "weight_depth"])
def _write(
    rgb,
    depth_m,
    target_rgb,
    target_depth_m,
    pixels,
    counts,
    v_rgb,
    v_depth,
    total,
    limit,
    weight_colour,
    weight_depth,
    BLOCK: tl.constexpr,
):
    """The two gradient images; every pixel is written. counts: the first two sums of the image."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < total
    r, g, b, d, _, _ = _gaps(rgb, depth_m, target_rgb, target_depth_m, pixels, at, total, limit)
    scale = weight_colour / tl.load(counts + _COLOUR_VALUES).to(tl.float32)
    store3(v_rgb, at, _sign(r) * scale, _sign(g) * scale, _sign(b) * scale, here)
    tl.store(
        v_depth + at,
        _sign(d) * (weight_depth / tl.load(counts + _DEPTH_PIXELS).to(tl.float32)),
        mask=here,
    )
