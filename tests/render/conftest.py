"""A seeded map of Gaussians, a camera, and the check of a gradient by finite differences."""

from dataclasses import dataclass

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import se3
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(
    width=27,
    height=19,
    fx=30.0,
    fy=28.0,
    cx=12.8,
    cy=10.1,
)
POSE = se3.exp(torch.tensor([0.1, -0.05, 0.2, 0.2, -0.3, 0.1], dtype=torch.float64))


def random_map(
    generator,
    n,
    *,
    degree=0,
    dtype=torch.float64,
    opacity=(0.3, 0.9),
    scale=0.12,
) -> GaussianParams:
    """``n`` Gaussians in front of ``CAMERA`` at ``POSE``, some beyond the image's border."""

    def uniform(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(n, low=1.0, high=3.0)
    x = uniform(n, low=-0.55, high=0.55) * z
    y = uniform(n, low=-0.45, high=0.45) * z
    rows = GaussianParams(
        xyz_W=se3.apply(POSE, torch.stack([x, y, z], dim=-1)),
        log_scale=uniform(n, 3, low=0.3, high=1.5).log() + torch.tensor(scale).log(),
        quat=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        opacity_logit=uniform(n, low=opacity[0], high=opacity[1]).logit(),
        sh=0.3 * torch.randn(n, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64),
    )
    return GaussianParams(**{name: getattr(rows, name).to(dtype) for name in COLUMNS})


COLUMNS = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


def finite_difference_check(forward, vjp, inputs, generator):
    """float64 gradcheck of ``vjp`` against central differences of two random sums of what
    ``forward`` returns."""
    weights = [
        [torch.randn(o.shape, generator=generator, dtype=torch.float64) for o in forward(*inputs)]
        for _ in range(2)
    ]

    class Bound(torch.autograd.Function):
        @staticmethod
        def forward(ctx, *x):
            ctx.x = x
            out = forward(*x)
            sums = [
                torch.stack([(o * v).sum() for o, v in zip(out, vs, strict=True)]).sum()
                for vs in weights
            ]
            return torch.stack(sums)

        @staticmethod
        def backward(ctx, v_sums):
            return vjp(
                ctx.x,
                *(v_sums[0] * a + v_sums[1] * b for a, b in zip(*weights, strict=True)),
            )

    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(
        Bound.apply,
        leaves,
        eps=1e-6,
        atol=1e-6,
        rtol=1e-5,
    )


@pytest.fixture(autouse=True)
def _reference():
    """Here the reference is tested; tests/kernels compares fast backends with it. One thread: the
    images are tiny."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with use_backend("reference"):
        yield
    torch.set_num_threads(threads)


@dataclass(frozen=True)
class Scene:
    """What the tests of the renderer share."""

    camera = CAMERA
    pose = POSE
    columns = COLUMNS
    random_map = staticmethod(random_map)
    finite_difference_check = staticmethod(finite_difference_check)


@pytest.fixture
def scene():
    return Scene()
