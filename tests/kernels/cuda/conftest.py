"""The CUDA kernels against the reference: on a GPU where there is one, else on CPU tensors in the emulator.

Which of the two is decided when the kernels are imported, so without a GPU these tests are collected only with
``GSFUSION_CUDA_EMULATOR`` in the environment; ``tests/kernels/test_cuda_parity.py`` runs them so. At the end the worst
differences are printed.
"""

import math
import os

import pytest
import torch

from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.types import Camera, GaussianParams

_RUNS = torch.cuda.is_available() or "GSFUSION_CUDA_EMULATOR" in os.environ
collect_ignore_glob = [] if _RUNS else ["test_*.py"]

PARITY: dict[tuple[str, str], tuple[float, float, int]] = {}
T_WC = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.3, 0.1]))


def pytest_terminal_summary(terminalreporter):
    if PARITY:
        terminalreporter.write_line("\nlargest difference from the reference: absolute, of the largest value; flips")
    for (operation, name), (absolute, relative, flips) in sorted(PARITY.items()):
        terminalreporter.write_line(f"  {operation:16} {name:16} {absolute:9.1e} {relative:9.1e} {flips:6d}")


@pytest.fixture(scope="session")
def device() -> torch.device:
    return torch.device("cpu" if "GSFUSION_CUDA_EMULATOR" in os.environ else "cuda")


@pytest.fixture
def compare():
    """``compare(op, name, ours, reference, tolerance, share)``: at most a ``share`` of values is off by more than a
    ``tolerance`` times the largest one; the worst of the others, and the number of those, go to the table."""

    def check(operation, name, ours, theirs, tolerance=1e-5, share=0.0):
        ours, theirs = ours.detach().cpu(), theirs.detach().cpu()
        assert ours.shape == theirs.shape
        assert ours.dtype == theirs.dtype
        if not ours.numel():
            return
        ours, theirs = ours.double(), theirs.double()
        assert bool(torch.isfinite(ours).all()), f"{operation} {name} is not finite"
        scale = float(theirs.abs().max()) or 1.0
        gap = (ours - theirs).abs()
        off = gap > tolerance * scale
        assert float(off.double().mean()) <= share, (
            f"{operation} {name}: {int(off.sum())} of {off.numel()} differ, the worst by {float(gap.max()):.2g}"
        )
        worst = float(torch.where(off, 0.0, gap).max())
        before = PARITY.get((operation, name), (0.0, 0.0, 0))
        PARITY[operation, name] = max(before[0], worst), max(before[1], worst / scale), before[2] + int(off.sum())

    return check


@pytest.fixture
def make_scene(generator):
    """``make_scene(n, degree)``: Gaussians in front of, beside and behind the camera of ``pose``, of every opacity."""

    def normal(*size: int):
        return torch.randn(*size, generator=generator)

    def make(n: int, degree: int, scale_m: float = 0.08) -> GaussianParams:
        in_camera = torch.stack([1.2 * normal(n), 1.2 * normal(n), 2.0 + 1.5 * normal(n)], dim=-1)
        return GaussianParams(
            xyz_W=se3.apply(T_WC, in_camera),
            log_scale=math.log(scale_m) + 0.5 * normal(n, 3),
            quat=quaternion.normalise(normal(n, 4)) * (0.5 + torch.rand(n, 1, generator=generator)),
            opacity_logit=3.0 * normal(n),
            sh=0.4 * normal(n, (degree + 1) ** 2, 3),
        )

    return make


@pytest.fixture
def pose() -> torch.Tensor:
    return T_WC


@pytest.fixture
def make_camera():
    def make(width: int, height: int) -> Camera:
        return Camera(width=width, height=height, fx=0.8 * width, fy=0.9 * width, cx=0.45 * width, cy=0.6 * height)

    return make


@pytest.fixture
def make_images(generator):
    """Three random images, as gradients of colour, depth and alpha."""

    def make(camera: Camera) -> list[torch.Tensor]:
        size = (camera.height, camera.width)
        return [torch.randn(shape, generator=generator) for shape in ((*size, 3), size, size)]

    return make


@pytest.fixture
def to(device):
    """``to(x)``: a tensor, or a dataclass of tensors, on the device of the kernels."""

    def move(value):
        if isinstance(value, torch.Tensor):
            return value.to(device)
        if isinstance(value, (list, tuple)):
            return [move(v) for v in value]
        return type(value)(**{k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in vars(value).items()})

    return move
