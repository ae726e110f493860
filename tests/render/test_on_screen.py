"""Visibility and size in the image, by hand and against the projection of every row."""

import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import (
    footprints,
    project_gaussians,
    render,
    render_forward,
    rows_in_view,
    tile_intersections,
)
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(
    width=40,
    height=30,
    fx=100.0,
    fy=100.0,
    cx=20.0,
    cy=15.0,
)


def gaussians(
    xyz: list[list[float]],
    scale: float = 0.01,
    opacity: float = 0.5,
) -> GaussianParams:
    n = len(xyz)
    return GaussianParams(
        xyz_W=torch.tensor(xyz).reshape(n, 3),
        log_scale=torch.full((n, 3), math.log(scale)),
        quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).clone(),
        opacity_logit=torch.full((n,), opacity).logit(),
        sh=torch.zeros(n, 1, 3),
    )


def test_size_of_a_round_gaussian_by_hand():
    """1 cm at 2 m and fx 100: variance 0.25 + 0.3 px^2; alpha falls to 1/255 at sqrt(2 ln(255 o))
    deviations."""
    seen = footprints(
        gaussians([[0.0, 0.0, 2.0]]),
        CAMERA,
        torch.eye(4),
    )
    assert seen.visible.tolist() == [True]
    torch.testing.assert_close(
        seen.radius_px,
        torch.tensor([math.sqrt(2 * math.log(127.5) * 0.55)]),
    )


def test_what_is_seen_by_hand():
    """In the middle; beside the image but reaching into it (centre 22 px right of the middle, 2.3
    px reach beyond 1.5); beside it; behind the camera; nearer than the near plane."""
    xyz = [[0.0, 0.0, 2.0], [0.43, 0.0, 2.0], [0.6, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.001]]
    seen = footprints(gaussians(xyz), CAMERA, torch.eye(4))
    assert seen.visible.tolist() == [True, True, False, False, False]
    assert (seen.radius_px > 0).tolist() == seen.visible.tolist()
    hidden = footprints(
        gaussians(xyz[:1], opacity=0.003),
        CAMERA,
        torch.eye(4),
    )
    assert hidden.visible.tolist() == [False]


def test_same_as_the_projection_of_every_row(generator):
    params = gaussians(
        (6 * torch.rand(500, 3, generator=generator) - 3).tolist(),
        scale=0.2,
    )
    params.sh[7] = torch.nan
    params.log_scale[9] = torch.inf
    p = project_gaussians(params, CAMERA, torch.eye(4))
    size = torch.tensor([CAMERA.width, CAMERA.height])
    expected = p.visible & ((p.uv + p.extent_px > 0) & (p.uv - p.extent_px < size)).all(1)
    expected[7] = False
    seen = footprints(params, CAMERA, torch.eye(4))
    assert expected.sum() > 20
    assert torch.equal(seen.visible, expected)
    assert torch.equal(seen.radius_px[expected], p.extent_px[expected].amax(1))
    assert footprints(params[:0], CAMERA, torch.eye(4)).visible.shape == (0,)


CAMERA_IN_VIEW = Camera(
    width=64,
    height=48,
    fx=40.0,
    fy=44.0,
    cx=30.0,
    cy=25.0,
)


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
    seen = rows_in_view(params, CAMERA_IN_VIEW, pose)
    p = project_gaussians(params, CAMERA_IN_VIEW, pose)
    size = torch.tensor([CAMERA_IN_VIEW.width, CAMERA_IN_VIEW.height])
    meets = p.visible & (p.uv + p.extent_px >= 0).all(1) & (p.uv - p.extent_px <= size).all(1)
    assert meets.any()
    assert not (meets & ~seen).any()
    if scale < 0.1:
        assert float(seen.double().mean()) < 0.5


@pytest.mark.parametrize(
    ("backend", "dtype"), [("reference", torch.float64), ("numba", torch.float32)]
)
def test_the_picture_does_not_change_without_the_others(generator, backend, dtype):
    """To rounding: exp of a row may differ in its last bit where the row falls into other lanes of
    a vector.

    In float32 a Gaussian within rounding of the 1/255 cut may then fall on either side of it: 1/255
    of a colour <= 1.
    """
    columns = vars(around(generator, 3000, scale=0.03))
    params = GaussianParams(**{name: value.to(dtype) for name, value in columns.items()})
    pose = torch.eye(4)
    seen = rows_in_view(params, CAMERA_IN_VIEW, pose)
    with use_backend(backend):
        every, few = (render(p, CAMERA_IN_VIEW, pose).rgb for p in (params, params[seen]))
    assert 100 < int(seen.sum()) < 2000
    off = (every - few).abs()
    assert float(off.max()) < (1e-7 if dtype == torch.float64 else 1 / 255 + 1e-4)
    assert float((off > (1e-7 if dtype == torch.float64 else 1e-4)).double().mean()) < 1e-3


def test_what_was_blended_at_a_pixel_gives_its_colour(generator):
    """The sum of w_k c_k over the list of a tile is the picture, and alpha and T are those of
    w_k."""
    n = 60
    params = gaussians(
        (torch.rand(n, 3, generator=generator) * torch.tensor([1.0, 0.8, 1.0])).tolist(),
        scale=0.05,
    )
    params.xyz_W.add_(torch.tensor([-0.5, -0.4, 1.5]))
    params.sh.copy_(torch.rand(n, 1, 3, generator=generator))
    with use_backend("reference"):
        output, saved = render_forward(params, CAMERA, torch.eye(4))
    screen = saved.screen
    places = {row: screen.tiles_with(row) for row in range(n)}
    longest = 0
    for tile in range(screen.tiles.tiles_x * screen.tiles.tiles_y):
        x, y = screen.pixels_of(tile, CAMERA)
        assert {screen.tile_of(int(u), int(v)) for u, v in zip(x, y, strict=True)} == {tile}
        blend = screen.blend(tile, x, y)
        longest = max(longest, len(blend.gaussian))
        assert blend.weight.shape == (len(blend.gaussian), len(x))
        torch.testing.assert_close(
            blend.weight.T @ screen.rgb[blend.gaussian],
            output.rgb[y, x],
            atol=1e-6,
            rtol=1e-5,
        )
        kept = blend.weight > 0
        torch.testing.assert_close(blend.weight[kept], (blend.alpha * blend.transmittance)[kept])
        for place, row in enumerate(blend.gaussian.tolist()):
            assert (tile, place) in places[row]
    assert longest > 5
    assert sum(map(len, places.values())) == int(screen.tiles.offset[-1])


def test_the_others_are_in_no_tile_s_list(generator):
    params = around(generator, 3000, scale=0.03)
    drawn = tile_intersections(
        project_gaussians(params, CAMERA_IN_VIEW, torch.eye(4)), CAMERA_IN_VIEW
    ).gaussian
    assert len(drawn) > 1000
    assert rows_in_view(params, CAMERA_IN_VIEW, torch.eye(4))[drawn].all()


def test_no_rows():
    params = around(torch.Generator().manual_seed(0), 5, scale=0.1)
    assert rows_in_view(params[:0], CAMERA_IN_VIEW, torch.eye(4)).shape == (0,)
