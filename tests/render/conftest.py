"""A seeded map of Gaussians, and a renderer that knows no tiles: every Gaussian at every pixel, by the book."""

from dataclasses import dataclass

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import se3
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(width=27, height=19, fx=30.0, fy=28.0, cx=12.8, cy=10.1)
POSE = se3.exp(torch.tensor([0.1, -0.05, 0.2, 0.2, -0.3, 0.1], dtype=torch.float64))


def random_map(generator, n, *, degree=0, dtype=torch.float64, opacity=(0.3, 0.9), scale=0.12) -> GaussianParams:
    """``n`` Gaussians in front of ``CAMERA`` at ``POSE``, some beyond the image's border."""

    def uniform(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(n, low=1.0, high=3.0)
    x, y = uniform(n, low=-0.55, high=0.55) * z, uniform(n, low=-0.45, high=0.45) * z
    rows = GaussianParams(
        xyz_W=se3.apply(POSE, torch.stack([x, y, z], dim=-1)),
        log_scale=uniform(n, 3, low=0.3, high=1.5).log() + torch.tensor(scale).log(),
        quat=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        opacity_logit=uniform(n, low=opacity[0], high=opacity[1]).logit(),
        sh=0.3 * torch.randn(n, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64),
    )
    return GaussianParams(**{name: getattr(rows, name).to(dtype) for name in COLUMNS})


COLUMNS = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


@dataclass
class Picture:
    """What the loop over all Gaussians gives, differentiable by autograd."""

    rgb: torch.Tensor
    depth_m: torch.Tensor
    alpha: torch.Tensor
    first_index: torch.Tensor
    dominant_index: torch.Tensor


def splat_by_the_book(params: GaussianParams, camera: Camera, T_WC):
    """u, v, covariance, depth, opacity, visible: matrices as printed in the EWA paper."""
    R_CW = T_WC[:3, :3].T
    xyz_C = (params.xyz_W - T_WC[:3, 3]) @ R_CW.T
    x, y, z = xyz_C.unbind(-1)
    w, i, j, k = (params.quat / params.quat.norm(dim=-1, keepdim=True)).unbind(-1)
    R_q = torch.stack(
        [
            torch.stack([1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)], -1),
            torch.stack([2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)], -1),
            torch.stack([2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)], -1),
        ],
        -2,
    )
    S2 = torch.diag_embed(torch.exp(2 * params.log_scale))
    cov_C = R_CW @ R_q @ S2 @ R_q.transpose(1, 2) @ R_CW.T
    limit_x, limit_y = 1.3 * camera.width / 2 / camera.fx, 1.3 * camera.height / 2 / camera.fy
    o = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([camera.fx / z, o, -camera.fx * (x / z).clamp(-limit_x, limit_x) / z], -1),
            torch.stack([o, camera.fy / z, -camera.fy * (y / z).clamp(-limit_y, limit_y) / z], -1),
        ],
        -2,
    )
    cov = J @ cov_C @ J.transpose(1, 2) + 0.3 * torch.eye(2, dtype=z.dtype)
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, cov, z, params.opacity_logit.sigmoid(), z > 0.2


def blend_by_the_book(u, v, conic, z, opacity, rgb, camera: Camera, drawn) -> Picture:
    """Nearest first, one Gaussian after another, whole image at once. ``conic`` is [N, 3]."""
    pixels = [torch.arange(size, dtype=z.dtype) + 0.5 for size in (camera.height, camera.width)]
    j, i = torch.meshgrid(*pixels, indexing="ij")
    zero = torch.zeros(camera.height, camera.width, dtype=z.dtype)
    T, heaviest, running = zero + 1, zero.clone(), zero == 0
    image, depth, alpha_sum = zero[..., None].expand(-1, -1, 3), zero, zero
    first, dominant = torch.full(zero.shape, -1), torch.full(zero.shape, -1)
    for n in z.argsort(stable=True).tolist():
        if not drawn[n]:
            continue
        dx, dy = i - u[n], j - v[n]
        A, B, C = conic[n]
        alpha = (opacity[n] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)).clamp(max=0.99)
        hit = running & (alpha >= 1 / 255)
        stops = hit & (T * (1 - alpha) < 1e-4)
        running = running & ~stops
        hit = hit & ~stops
        w = torch.where(hit, alpha * T, 0)
        image, depth, alpha_sum = image + w[..., None] * rgb[n], depth + w * z[n], alpha_sum + w
        first = torch.where(hit & (first < 0), n, first)
        dominant = torch.where(w.detach() > heaviest, n, dominant)
        heaviest = torch.maximum(heaviest, w.detach())
        T = torch.where(hit, T * (1 - alpha), T)
    return Picture(image, depth, alpha_sum, first, dominant)


def render_by_the_book(params: GaussianParams, camera: Camera, T_WC, rgb) -> Picture:
    """The whole picture for given colours."""
    u, v, cov, z, opacity, drawn = splat_by_the_book(params, camera, T_WC)
    Q = torch.linalg.inv(cov)
    return blend_by_the_book(
        u, v, torch.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]], -1), z, opacity, rgb, camera, drawn
    )


def finite_difference_check(forward, vjp, inputs, generator):
    """float64 gradcheck of ``vjp`` against central differences of two random sums of what ``forward`` returns."""
    weights = [
        [torch.randn(o.shape, generator=generator, dtype=torch.float64) for o in forward(*inputs)] for _ in range(2)
    ]

    class Bound(torch.autograd.Function):
        @staticmethod
        def forward(ctx, *x):
            ctx.x = x
            out = forward(*x)
            sums = [torch.stack([(o * v).sum() for o, v in zip(out, vs, strict=True)]).sum() for vs in weights]
            return torch.stack(sums)

        @staticmethod
        def backward(ctx, v_sums):
            return vjp(ctx.x, *(v_sums[0] * a + v_sums[1] * b for a, b in zip(*weights, strict=True)))

    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(Bound.apply, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.fixture(autouse=True)
def _reference():
    """Here the reference is tested; fast backends are compared with it elsewhere. One thread: the images are tiny."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with use_backend("reference"):
        yield
    torch.set_num_threads(threads)


@dataclass(frozen=True)
class Book:
    """What the tests of the renderer share."""

    camera = CAMERA
    pose = POSE
    columns = COLUMNS
    random_map = staticmethod(random_map)
    splat = staticmethod(splat_by_the_book)
    blend = staticmethod(blend_by_the_book)
    render = staticmethod(render_by_the_book)
    finite_difference_check = staticmethod(finite_difference_check)


@pytest.fixture
def book():
    return Book()
