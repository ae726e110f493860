"""The loss of an online step: numba against the reference, values and gradient."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import l1_mse_vjp

pytest.importorskip("numba")


@pytest.mark.parametrize("size", [(1, 1), (37, 53), (240, 320)])
def test_same_as_the_reference(size, generator):
    rgb, target = 1.4 * torch.rand(*size, 3, generator=generator) - 0.2, torch.rand(*size, 3, generator=generator)
    rgb[-1] = target[-1]  # equal: no gradient
    expected = l1_mse_vjp.reference(rgb, target)
    for image in (rgb, rgb.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
        with use_backend("numba"):
            actual = l1_mse_vjp(image, target)
        for name in ("value", "mse"):
            torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=1e-5, atol=0.0)
        assert torch.equal(actual.v_rgb, expected.v_rgb)


def test_float64_goes_to_the_reference(generator):
    rgb, target = (torch.rand(5, 7, 3, dtype=torch.float64, generator=generator) for _ in range(2))
    with use_backend("numba"):
        assert l1_mse_vjp(rgb, target).v_rgb.dtype == torch.float64
