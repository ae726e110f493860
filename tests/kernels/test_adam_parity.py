import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import adam_update

pytest.importorskip("numba")


@pytest.mark.parametrize("shape", [(0, 3), (1,), (7, 3), (2100, 16, 3)])
@pytest.mark.parametrize("mode", ["none", "shared", "per_row"])
def test_updates_agree(shape, mode, generator):
    g = [torch.randn(shape, generator=generator) for _ in range(3)]
    lr = torch.rand(shape[1:], generator=generator) if len(shape) > 1 else 0.1
    results = {}
    for backend in ("reference", "numba"):
        param, m, v = torch.ones(shape), torch.zeros(shape), torch.zeros(shape)
        with use_backend(backend):
            for t, gradient in enumerate(g, start=1):
                steps = {"none": None, "shared": t, "per_row": torch.full(shape[:1], t, dtype=torch.int32)}[mode]
                adam_update(param, gradient, m, v, steps, lr=lr, beta1=0.9, beta2=0.999, eps=1e-15)
        results[backend] = param, m, v
    for a, b in zip(*results.values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def test_strided_views_are_updated_in_place(generator):
    """The map hands out the rows in use of larger buffers."""
    buffer = torch.zeros(10, 3)
    gradient, m, v = torch.ones(4, 3), torch.zeros(4, 3), torch.zeros(4, 3)
    with use_backend("numba"):
        adam_update(buffer[:4], gradient, m, v, None, lr=1.0, beta1=0.9, beta2=0.999, eps=1e-15)
    assert buffer[:4].lt(-3.1).all()
    assert buffer[4:].eq(0).all()
