"""The cheap test of what a camera sees leaves nothing out, and leaves most of what it does not see out."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import project_gaussians, render, rows_in_view, tile_intersections
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(width=64, height=48, fx=40.0, fy=44.0, cx=30.0, cy=25.0)


def around(generator, n: int, *, scale: float) -> GaussianParams:
    """Gaussians on all sides of the origin, a tenth to four metres away, of every shape."""
    direction = torch.randn(n, 3, generator=generator)
    distance = 0.1 + 4 * torch.rand(n, 1, generator=generator)
    return GaussianParams(
        xyz_W=direction / direction.norm(dim=1, keepdim=True) * distance,
        log_scale=torch.tensor(scale).log() + 1.5 * torch.randn(n, 3, generator=generator),
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=3 * torch.randn(n, generator=generator),
        sh=torch.rand(n, 1, 3, generator=generator),
    )


@pytest.mark.parametrize("scale", [0.002, 0.03, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_every_row_whose_box_meets_the_picture_is_in_view(scale, seed):
    generator = torch.Generator().manual_seed(seed)
    params = around(generator, 4000, scale=scale)
    pose = se3.exp(0.5 * torch.randn(6, generator=generator))
    seen = rows_in_view(params, CAMERA, pose)
    p = project_gaussians(params, CAMERA, pose)
    size = torch.tensor([CAMERA.width, CAMERA.height])
    meets = p.visible & (p.uv + p.extent_px >= 0).all(1) & (p.uv - p.extent_px <= size).all(1)
    assert meets.any()
    assert not (meets & ~seen).any()
    if scale < 0.1:
        assert float(seen.double().mean()) < 0.5


def test_the_others_are_in_no_tile_s_list(generator):
    params = around(generator, 3000, scale=0.03)
    drawn = tile_intersections(project_gaussians(params, CAMERA, torch.eye(4)), CAMERA).gaussian
    assert len(drawn) > 1000
    assert rows_in_view(params, CAMERA, torch.eye(4))[drawn].all()


@pytest.mark.parametrize(("backend", "dtype"), [("reference", torch.float64), ("numba", torch.float32)])
def test_the_picture_does_not_change_without_the_others(generator, backend, dtype):
    """To rounding: exp of a row may differ in its last bit where the row falls into other lanes of a vector.

    In float32 a Gaussian within rounding of the 1/255 cut may then fall on either side of it: 1/255 of a colour <= 1.
    """
    columns = vars(around(generator, 3000, scale=0.03))
    params, pose = GaussianParams(**{name: value.to(dtype) for name, value in columns.items()}), torch.eye(4)
    seen = rows_in_view(params, CAMERA, pose)
    with use_backend(backend):
        every, few = (render(p, CAMERA, pose).rgb for p in (params, params[seen]))
    assert 100 < int(seen.sum()) < 2000
    off = (every - few).abs()
    assert float(off.max()) < (1e-7 if dtype == torch.float64 else 1 / 255 + 1e-4)
    assert float((off > (1e-7 if dtype == torch.float64 else 1e-4)).double().mean()) < 1e-3


def test_no_rows():
    params = around(torch.Generator().manual_seed(0), 5, scale=0.1)
    assert rows_in_view(params[:0], CAMERA, torch.eye(4)).shape == (0,)
