"""Features: where they sit, what depth they get, how they spread."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import project
from gsfusion_nb.tracking.features import extract_features
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=160,
    height=120,
    fx=130.0,
    fy=125.0,
    cx=81.0,
    cy=58.5,
)


@pytest.fixture(scope="module")
def view():
    return room(n_frames=200, width=320, height=240)[10]


def frame(rgb, depth_m, camera=CAMERA):
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_WC=torch.eye(4),
    )


def noise(generator, height=120, width=160):
    return torch.rand(height, width, 3, generator=generator)


def test_a_mirrored_image_has_mirrored_features_on_every_level(view):
    """Pixel edges are the same edges after mirroring, so u -> W - u; a wrong half pixel would show
    as its double."""
    mirrored = dataclasses.replace(
        view,
        rgb=view.rgb.flip(1).contiguous(),
        depth_m=view.depth_m.flip(1).contiguous(),
    )
    a = extract_features(view, count=1000, levels=8)
    b = extract_features(mirrored, count=1000, levels=8)
    uv = b.uv.clone()
    uv[:, 0] = view.camera.width - uv[:, 0]
    apart = torch.cdist(a.uv, uv) + 1e3 * (a.sigma_px[:, None] != b.sigma_px[None])
    nearest, match = apart.min(1)
    assert len(a.sigma_px.unique()) == 8
    for sigma in a.sigma_px.unique():
        known = (a.sigma_px == sigma) & (nearest < 3)
        assert known.sum() >= 0.7 * (a.sigma_px == sigma).sum()
        assert (a.uv[known] - uv[match[known]]).abs().median() < 1e-3


def test_points_project_back_onto_their_pixels(view):
    f = extract_features(view, count=500, levels=8)
    known = f.has_depth
    assert known.float().mean() > 0.6
    torch.testing.assert_close(
        project(view.camera, f.xyz_C[known]),
        f.uv[known],
        atol=1e-3,
        rtol=0,
    )
    assert (f.xyz_C[~known] == 0).all()


def test_depth_on_a_slanted_plane_is_exact(generator):
    """On n . x = d the depth behind (u, v) is d / (n . ray)."""
    n = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
    d = 2.0
    u = torch.arange(160, dtype=torch.float64) + 0.5
    v = torch.arange(120, dtype=torch.float64) + 0.5

    def depth(u, v):
        return d / (n[0] * (u - CAMERA.cx) / CAMERA.fx + n[1] * (v - CAMERA.cy) / CAMERA.fy + n[2])

    f = extract_features(
        frame(noise(generator), depth(u[None, :], v[:, None]).float()),
        count=300,
        levels=4,
    )
    assert f.has_depth.sum() > 100
    at = f.uv[f.has_depth].double()
    torch.testing.assert_close(
        f.xyz_C[f.has_depth, 2].double(),
        depth(at[:, 0], at[:, 1]),
        atol=2e-5,
        rtol=0,
    )


def test_a_poster_does_not_take_all_features(generator):
    """Strong texture on a quarter of the width, weak texture elsewhere."""
    rgb = 0.5 + 0.15 * (noise(generator) - 0.5)
    rgb[:, :40] = noise(generator, 120, 40)
    f = extract_features(
        frame(rgb, torch.ones(120, 160)),
        count=200,
        levels=2,
    )
    assert len(f) == 200
    assert (f.uv[:, 0] > 40).float().mean() > 0.5


def test_no_depth_at_edges_and_holes(generator):
    depth_m = torch.full((120, 160), 1.0)
    depth_m[:, 80:] = 2.0
    depth_m[60:64] = 0.0
    f = extract_features(frame(noise(generator), depth_m), count=600, levels=3)
    u, v = f.uv.T
    at_edge = (u - 80).abs() < 1
    in_hole = (v > 59.5) & (v < 64.5)
    assert at_edge.any()
    assert in_hole.any()
    assert not f.has_depth[at_edge | in_hole].any()
    clear = ((u - 80).abs() > 3) & ((v < 57) | (v > 67)) & (u > 3) & (u < 157)
    assert f.has_depth[clear].all()
    torch.testing.assert_close(
        f.xyz_C[clear, 2],
        torch.where(u[clear] < 80, 1.0, 2.0),
    )


@pytest.mark.parametrize("size", [(8, 8), (9, 70), (120, 160)])
def test_plain_black_and_tiny_frames_have_none(size):
    height, width = size
    camera = Camera(
        width=width,
        height=height,
        fx=50.0,
        fy=50.0,
        cx=width / 2,
        cy=height / 2,
    )
    f = extract_features(
        frame(torch.zeros(height, width, 3), torch.zeros(height, width), camera),
        count=100,
        levels=8,
    )
    assert len(f) == 0
    assert f.descriptors.shape == (0, 32)
    assert f.xyz_C.shape == (0, 3)


def test_without_depth_features_stay(generator):
    f = extract_features(
        frame(noise(generator), torch.zeros(120, 160)),
        count=100,
        levels=4,
    )
    assert len(f) == 100
    assert not f.has_depth.any()


def test_repeats_exactly(view):
    a, b = (extract_features(view, count=400, levels=8) for _ in range(2))
    assert torch.equal(a.uv, b.uv)
    assert torch.equal(a.descriptors, b.descriptors)


def test_wrong_numbers_are_refused(view):
    with pytest.raises(ValueError, match="at least 1, got 0 and 8"):
        extract_features(view, count=0, levels=8)
