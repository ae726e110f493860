"""RTG-SLAM's loss: numba against the reference, values and gradients."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import rgbd_l1_vjp


@pytest.mark.parametrize("behind_m", [None, 0.1])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_same_as_the_reference(generator, behind_m, share):
    def image(*shape):
        return torch.rand(37, 53, *shape, generator=generator)

    rgb, target_rgb = image(3), image(3)
    depth_m, target_depth_m = (image() * (image() > 0.2) for _ in range(2))
    depth_m[3], rgb[4] = target_depth_m[3], target_rgb[4]  # equal: no gradient
    pixels = image() < share
    options = {"weight_colour": 0.8, "weight_depth": 2.0, "behind_m": behind_m}
    results = []
    for backend in ("reference", "numba"):
        with use_backend(backend):
            results.append(rgbd_l1_vjp(rgb, depth_m, target_rgb, target_depth_m, pixels, **options))
    expected, actual = results
    for name in ("colour", "depth_m", "total"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=1e-5, atol=0.0)
    torch.testing.assert_close(actual.v_rgb, expected.v_rgb)
    torch.testing.assert_close(actual.v_depth_m, expected.v_depth_m)
