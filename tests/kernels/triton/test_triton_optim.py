"""Losses and Adam."""

# pyright: reportFunctionMemberAccess=false

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.optim import adam_update, dssim_vjp, l1_mse_vjp
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp


@pytest.mark.parametrize("shape", [(0, 3), (1,), (7, 3), (90, 16, 3)])
@pytest.mark.parametrize("mode", ["none", "shared", "per_row"])
def test_updates_agree(shape, mode, to, compare, generator):
    gradients = [torch.randn(shape, generator=generator) for _ in range(3)]
    lr = torch.rand(shape[1:], generator=generator) if len(shape) > 1 else 0.1
    ours, theirs = ([torch.ones(shape), torch.zeros(shape), torch.zeros(shape)] for _ in range(2))
    ours = to(ours)
    for t, gradient in enumerate(gradients, start=1):
        steps = {"none": None, "shared": t, "per_row": torch.full(shape[:1], t, dtype=torch.int32)}[mode]
        rates = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
        adam_update.reference(theirs[0], gradient, *theirs[1:], steps, lr=lr, **rates)
        with use_backend("triton"):
            steps = to(steps) if isinstance(steps, torch.Tensor) else steps
            adam_update(ours[0], to(gradient), *ours[1:], steps, lr=lr, **rates)
    for name, a, b in zip(("param", "exp_avg", "exp_avg_sq"), ours, theirs, strict=True):
        compare("adam_update", name, a, b, 2e-6)


def test_rows_of_larger_buffers_are_updated_in_place(to):
    buffer = to(torch.zeros(10, 3))
    gradient, m, v = (to(t) for t in (torch.ones(4, 3), torch.zeros(4, 3), torch.zeros(4, 3)))
    with use_backend("triton"):
        adam_update(buffer[:4], gradient, m, v, None, lr=1.0, beta1=0.9, beta2=0.999, eps=1e-15)
    assert buffer[:4].lt(-3.1).all()
    assert buffer[4:].eq(0).all()


@pytest.mark.parametrize("behind_m", [None, 0.1])
@pytest.mark.parametrize("size", [(1, 1), (40, 33)])
def test_rgbd_loss(size, behind_m, to, compare, generator):
    images = [torch.rand(*size, *n, generator=generator) for n in ((3,), (), (3,), ())]
    for depth in images[1::2]:
        depth[torch.rand(size, generator=generator) < 0.3] = 0.0
    pixels = torch.rand(size, generator=generator) < 0.7
    options = {"weight_colour": 0.7, "weight_depth": 1.3, "behind_m": behind_m}
    for wanted in (pixels, pixels & False):
        expected = rgbd_l1_vjp.reference(*images, wanted, **options)
        with use_backend("triton"):
            found = rgbd_l1_vjp(*to(images), to(wanted), **options)
        for name in ("colour", "depth_m", "total"):
            compare("rgbd_l1_vjp", name, getattr(found, name), getattr(expected, name), 1e-5)
        for name in ("v_rgb", "v_depth_m"):
            compare("rgbd_l1_vjp", name, getattr(found, name), getattr(expected, name), 1e-6)


@pytest.mark.parametrize("size", [(1, 1), (40, 33)])
def test_l1(size, to, compare, generator):
    rgb, target = 1.4 * torch.rand(*size, 3, generator=generator) - 0.2, torch.rand(*size, 3, generator=generator)
    rgb[-1, -1] = target[-1, -1]
    expected = l1_mse_vjp.reference(rgb, target)
    with use_backend("triton"):
        found = l1_mse_vjp(to(rgb), to(target))
    for name in ("value", "mse", "v_rgb"):
        compare("l1_mse_vjp", name, getattr(found, name), getattr(expected, name), 1e-6)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (11, 16), (40, 33)])
def test_dssim(size, to, compare, generator):
    x = torch.rand(*size, 3, generator=generator)
    y = (x + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)
    expected, v_expected = dssim_vjp.reference(x.double(), y.double(), 0.7)
    with use_backend("triton"):
        loss, v = dssim_vjp(to(x), to(y), 0.7)
    compare("dssim_vjp", "loss", loss.double(), expected, 1e-5)
    compare("dssim_vjp", "v_rgb", v.double(), v_expected, 2e-5)
