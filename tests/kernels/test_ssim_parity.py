"""The numba D-SSIM beyond what ``test_parity.py`` compares."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import dssim_vjp

pytest.importorskip("numba")


def test_equal_images(generator):
    x = torch.rand(20, 31, 3, generator=generator)
    with use_backend("numba"):
        loss, v = dssim_vjp(x, x)
    assert loss.item() == pytest.approx(0, abs=1e-5)
    assert v.abs().max() < 1e-5


def test_threads_do_not_change_a_bit(generator):
    x, y = torch.rand(50, 70, 3, generator=generator), torch.rand(50, 70, 3, generator=generator)
    results = []
    with use_backend("numba"):
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(dssim_vjp(x, y))
    torch.set_num_threads(1)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
