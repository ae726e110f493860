"""The operations of an RTG-SLAM step on a map of real size: where blocks, warps and sums are
many."""

import pytest
import torch
from torch import Tensor

from gsfusion_nb.config import rtg_slam
from gsfusion_nb.data.room import room
from gsfusion_nb.mapping import RTGSLAM
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp
from gsfusion_nb.render import disc_depth, disc_depth_vjp, render_forward, render_vjp
from gsfusion_nb.types import GaussianParams

SIZE = (320, 240) if torch.cuda.is_available() else (80, 60)
N_FRAMES = 2
OPAQUE = 0.6


@pytest.fixture(scope="module")
def mapped():
    sequence = room(n_frames=200, width=SIZE[0], height=SIZE[1])
    mapper = RTGSLAM(rtg_slam("room"))
    for i in range(N_FRAMES):
        mapper.step(sequence[i])
    return mapper.gaussians.params, sequence[N_FRAMES]


def step(
    params: GaussianParams,
    frame,
    known: dict[str, Tensor],
    device: str,
) -> dict[str, Tensor]:
    """Every operation, on ``device``. Where the discs that the pixels hit, the picture or the depth
    of the discs are ``known``, what follows from them starts from these: rounding decides which
    disc is hit and the sign of an error."""
    params = GaussianParams(**{name: column.to(device) for name, column in vars(params).items()})
    frame = frame.to(device)
    pixels = frame.depth_m > 0
    pixels[: SIZE[1] // 3, : SIZE[0] // 3] = False
    rows = (torch.arange(len(params)) % 3 > 0).to(device)
    view = (params, frame.camera, frame.T_WC)
    out, saved = render_forward(*view, with_indices=False, opaque_alpha=OPAQUE, pixels=pixels)
    assert out.hit_index is not None
    known = {"hit": out.hit_index, "rgb": out.rgb, "target": frame.rgb} | known
    hit, rgb, target = (known[name].to(device) for name in ("hit", "rgb", "target"))
    disc = disc_depth(*view, hit, max_offset=3.0, min_cosine=0.1)
    depth_m = ({"disc depth": disc.depth_m} | known)["disc depth"].to(device)
    loss = rgbd_l1_vjp(
        rgb,
        depth_m,
        target,
        frame.depth_m,
        pixels,
        weight_colour=0.7,
        weight_depth=1.0,
        behind_m=0.1,
    )
    gradients = render_vjp(saved, loss.v_rgb, rows=rows)
    v_xyz, v_quat = disc_depth_vjp(
        *view, hit, loss.v_depth_m, rows=rows, max_offset=3.0, min_cosine=0.1
    )
    values = {
        "target": target,
        "rgb": out.rgb,
        "alpha": out.alpha,
        "hit": out.hit_index,
        "disc depth": disc.depth_m,
    }
    values |= {
        "v_rgb": loss.v_rgb,
        "v_depth": loss.v_depth_m,
        "disc v_xyz": v_xyz,
        "disc v_quat": v_quat,
    }
    values |= {f"v_{name}": column for name, column in vars(gradients).items()}
    return {name: value.detach().cpu() for name, value in values.items()}


def check(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """At most one value in 500 differs by more than a thousandth of the largest: rounding decides
    signs and limits."""
    for name, value in expected.items():
        assert found[name].shape == value.shape, name
        scale = float(value.double().abs().max()) or 1.0
        off = (found[name].double() - value.double()).abs() > (0 if name == "hit" else 1e-3 * scale)
        assert float(off.double().mean()) <= 2e-3, (
            f"{name}: {int(off.sum())} of {off.numel()} differ"
        )
    size = {
        name: float(value.double().norm())
        for name, value in expected.items()
        if name.startswith("v_")
    }
    gap = {name: float((found[name] - expected[name]).double().norm()) for name in size}
    assert not [name for name in size if gap[name] > 0.02 * size[name]], (gap, size)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_step_on_the_gpu_is_that_of_the_processor(mapped):
    params, frame = mapped
    expected = step(params, frame, {}, "cpu")
    assert len(params) > 5000
    assert float((expected["hit"] >= 0).double().mean()) > 0.5
    check(step(params, frame, expected, "cuda"), expected)


def test_the_comparison_finds_a_wrong_value(mapped):
    params, frame = mapped
    expected = step(params, frame, {}, "cpu")
    check(step(params, frame, expected, "cpu"), expected)
    with pytest.raises(AssertionError, match="v_depth"):
        check({**expected, "v_depth": -expected["v_depth"]}, expected)
