"""Frames on another pixel grid."""

import pytest
import torch

from gsfusion_nb.data import resize_frame
from gsfusion_nb.types import Camera, Frame


def frame(width, height, generator):
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.rand(height, width, 3, generator=generator),
        depth_m=torch.rand(height, width, generator=generator) + 1,
        camera=Camera(width=width, height=height, fx=10.0, fy=10.0, cx=width / 2, cy=height / 2),
        T_WC=torch.eye(4),
    )


def test_halving_by_hand(generator):
    f = frame(6, 4, generator)
    out = resize_frame(f, f.camera.resized(3, 2))
    assert torch.allclose(
        out.rgb,
        f.rgb.reshape(2, 2, 3, 2, 3).mean(dim=(1, 3)),
        atol=1e-6,
    )
    assert torch.equal(out.depth_m, f.depth_m[::2, ::2])
    assert (out.camera.fx, out.camera.cx) == (5.0, 1.5)


@pytest.mark.parametrize(
    "size",
    [(5, 3), (7, 5), (4, 4), (1, 1), (13, 9), (9, 7)],
)
def test_area_average_and_nearest_depth(generator, size):
    """Witness: overlap of the pixels' intervals along each axis, and a search for the nearest
    centre."""
    f = frame(9, 7, generator)
    out = resize_frame(f, f.camera.resized(*size))
    assert out.rgb.shape == (size[1], size[0], 3)
    nearest = []
    for n, m in ((size[1], 7), (size[0], 9)):
        centres = (torch.arange(n) + 0.5) * m / n
        sources = torch.arange(m) + 0.5
        nearest.append((centres[:, None] - sources).abs().argmin(dim=1))
    assert torch.equal(out.depth_m, f.depth_m[nearest[0]][:, nearest[1]])
    if size[0] <= 9 and size[1] <= 7:
        weights = []
        for n, m in ((size[1], 7), (size[0], 9)):
            low = torch.arange(n)[:, None] * m / n
            high = (torch.arange(n)[:, None] + 1) * m / n
            k = torch.arange(m)
            overlap = (torch.minimum(high, k + 1.0) - torch.maximum(low, k * 1.0)).clamp(min=0)
            weights.append(overlap / overlap.sum(dim=1, keepdim=True))
        expected = torch.einsum("ij,jkc,lk->ilc", weights[0], f.rgb, weights[1])
        assert torch.allclose(out.rgb, expected, atol=2e-6)


def test_same_size_and_input_untouched(generator):
    f = frame(6, 4, generator)
    rgb = f.rgb.clone()
    depth_m = f.depth_m.clone()
    assert resize_frame(f, f.camera).rgb is f.rgb
    resize_frame(f, f.camera.resized(3, 2))
    assert torch.equal(f.rgb, rgb)
    assert torch.equal(f.depth_m, depth_m)
