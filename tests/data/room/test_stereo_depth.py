"""Depth as a stereo camera measures it: its error, its flying pixels and its holes."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data.room import room, stereo_depth
from gsfusion_nb.data.room.depth_noise import STEREO_BASELINE_M, STEREO_SIGMA_PX
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=424,
    height=240,
    fx=275.0,
    fy=275.0,
    cx=212.0,
    cy=120.0,
)
"""Half as wide as the pictures in which disparities are looked for."""


def textured() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (240, 424, 3), generator=generator, dtype=torch.uint8)


def measured(depth_m: torch.Tensor, rgb_u8: torch.Tensor | None = None) -> torch.Tensor:
    picture = textured() if rgb_u8 is None else rgb_u8
    return stereo_depth(depth_m, picture, CAMERA, rng=np.random.default_rng(0))


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_the_error_grows_with_the_square_of_depth(z):
    seen = measured(torch.full((240, 424), z))
    sigma_m = z**2 * STEREO_SIGMA_PX / (2 * CAMERA.fx * STEREO_BASELINE_M)
    assert (seen > 0).all()
    assert float((seen - z).std()) == pytest.approx(sigma_m, rel=0.15)


def test_the_error_is_a_bump_and_not_of_a_pixel():
    """Neighbours err alike, pixels ten apart do not."""
    error = measured(torch.full((240, 424), 2.0)).double().numpy() - 2.0
    error -= error.mean()

    def correlation(pixels: int) -> float:
        return float((error[:, :-pixels] * error[:, pixels:]).mean() / error.var())

    assert correlation(1) > 0.5
    assert abs(correlation(10)) < 0.1


def test_pixels_fly_between_the_two_sides_of_an_edge_and_nowhere_else():
    depth_m = torch.full((240, 424), 3.0)
    depth_m[:, 200:] = 1.0
    seen = measured(depth_m)
    flies = (seen > 1.2) & (seen < 2.6)
    columns = flies.any(dim=0).nonzero()
    assert flies.sum() > 50
    assert columns.min() >= 195
    assert columns.max() <= 205


def test_what_the_second_lens_cannot_see_and_what_is_out_of_range_is_a_hole():
    """The near half hides f b (1/1 - 1/3) = 9 pixels of the far one on its left."""
    depth_m = torch.full((240, 424), 3.0)
    depth_m[:, 200:] = 1.0
    seen = measured(depth_m)
    assert (seen[:, 192:198] == 0).float().mean() > 0.9
    assert (seen[:, :180] > 0).all()
    assert (measured(torch.full((240, 424), 0.2)) == 0).all()
    assert (measured(torch.full((240, 424), 7.0)) == 0).all()
    assert (measured(torch.zeros(240, 424)) == 0).all()


def test_a_plain_wall_is_a_hole():
    picture = textured()
    picture[:, :200] = 128
    seen = measured(torch.full((240, 424), 2.0), picture)
    assert (seen[:, :195] == 0).all()
    assert (seen[:, 205:] > 0).all()


def test_the_room_has_it_as_a_noise_and_repeats_it():
    clean, noisy, again = (
        room(n_frames=20, noise=noise, width=160, height=120)[9]
        for noise in ("none", "stereo", "stereo")
    )
    assert torch.equal(noisy.depth_m, again.depth_m)
    assert torch.equal(noisy.rgb_u8, clean.rgb_u8)
    is_seen = noisy.depth_m > 0
    assert 0.3 < float(is_seen.float().mean()) < 0.95
    assert float((noisy.depth_m - clean.depth_m)[is_seen].abs().median()) < 0.03
    with pytest.raises(ValueError, match="noise must be one of none, kinect, stereo"):
        room(noise="stero")
