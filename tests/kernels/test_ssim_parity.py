import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import dssim_vjp

pytest.importorskip("numba")


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (11, 16), (40, 33), (61, 95)])
def test_value_and_gradient_agree(size, generator):
    x = torch.rand(*size, 3, generator=generator)
    y = (x + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)
    expected, v_expected = dssim_vjp.reference(x.double(), y.double(), 0.7)  # pyright: ignore[reportFunctionMemberAccess]
    with use_backend("numba"):
        loss, v = dssim_vjp(x, y, 0.7)
    torch.testing.assert_close(loss.double(), expected, rtol=0, atol=2e-6)
    # worst seen 3e-6 of the largest entry: E[x^2] - E[x]^2 cancels in float32, for the reference as well
    torch.testing.assert_close(v.double(), v_expected, rtol=0, atol=2e-5 * float(v_expected.abs().max()))


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
