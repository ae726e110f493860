"""Mesh views: painted by hand, reduced, drawn by VTK where it can draw, and a sentence where it cannot."""

import sys

import numpy as np
import pytest
import torch

from gsfusion_nb.types import Camera, Mesh
from gsfusion_nb.viz import gl, orbit_camera, show_mesh
from gsfusion_nb.viz.mesh_picture import BACKGROUND, draw_mesh
from gsfusion_nb.viz.mesh_reduction import reduced
from gsfusion_nb.viz.mesh_view import mesh_picture

CAMERA = Camera(width=160, height=120, fx=223.923, fy=223.923, cx=80.0, cy=60.0)


def sheet(n=2, colours=((1.0, 0, 0), (0, 0, 1.0))):
    """A square of 1 m in the plane z = 0, facing +z, n x n vertices, first colour at x < 0, second at x > 0."""
    line = torch.linspace(-0.5, 0.5, n)
    x, y = torch.meshgrid(line, line, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    i = torch.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].flatten(), i[1:, :-1].flatten(), i[1:, 1:].flatten(), i[:-1, 1:].flatten()
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    left, right = (torch.tensor(c) for c in colours)
    return Mesh(vertices_W=vertices, faces=faces, rgb=torch.where((vertices[:, :1] < 0), left, right))


FROM_ABOVE = orbit_camera((0, 0, 0), -90, 90, 2.0)  # +y up in the picture, +x right
FROM_BELOW = orbit_camera((0, 0, 0), -90, -90, 2.0)


def test_painted_square_by_hand():
    image = draw_mesh(sheet(21), CAMERA, FROM_ABOVE)
    inside = np.nonzero((image != BACKGROUND).any(-1))
    assert (inside[0].min(), inside[0].max()) == pytest.approx((60 - 56, 60 + 56), abs=1.5)
    assert (inside[1].min(), inside[1].max()) == pytest.approx((80 - 56, 80 + 56), abs=1.5)
    assert image[60, 60].argmax() == 0
    assert image[60, 100].argmax() == 2


def test_faces_seen_from_behind_are_left_out():
    assert (draw_mesh(sheet(3), CAMERA, FROM_BELOW) == BACKGROUND).all()


def test_nearer_triangles_cover_farther_ones_in_any_order():
    low, high = sheet(5, ((1.0, 0, 0), (1.0, 0, 0))), sheet(5, ((0, 1.0, 0), (0, 1.0, 0)))
    lifted = high.vertices_W + torch.tensor([0.0, 0, 0.3])
    for first, second in ((low.vertices_W, lifted), (lifted, low.vertices_W)):
        rgb = torch.cat([low.rgb, high.rgb] if first is low.vertices_W else [high.rgb, low.rgb])
        both = Mesh(vertices_W=torch.cat([first, second]), faces=torch.cat([low.faces, low.faces + 25]), rgb=rgb)
        assert draw_mesh(both, CAMERA, FROM_ABOVE)[60, 80].argmax() == 1


def test_shape_shading_ignores_colour_and_nothing_is_painted_of_an_empty_mesh():
    image = draw_mesh(sheet(3), CAMERA, FROM_ABOVE, shading="shape")
    assert np.abs(image[60, 60].astype(int) - image[60, 100]).max() < 6
    assert image[60, 60].max() == image[60, 60].min()
    none = Mesh(vertices_W=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.int64), rgb=torch.zeros(0, 3))
    assert (draw_mesh(none, CAMERA, FROM_ABOVE) == BACKGROUND).all()


def test_reduction_keeps_extent_area_colours_and_sides():
    mesh = sheet(101)
    small = reduced(mesh, 2_000)
    assert 500 < len(small.faces) <= 2_000
    assert int(small.faces.max()) < len(small.vertices_W)
    assert torch.allclose(small.vertices_W.amax(0), torch.tensor([0.5, 0.5, 0.0]), atol=0.03)
    corners = small.vertices_W[small.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 2] >= 0).all()
    assert float(normal[:, 2].sum() / 2) == pytest.approx(1.0, rel=0.06)
    far = small.vertices_W[:, 0].abs() > 0.05
    blue = small.vertices_W[far, 0] > 0
    assert (small.rgb[far, 2] > 0.9).equal(blue)
    assert reduced(mesh, 10**6) is mesh
    assert len(reduced(mesh, 1).faces) <= 1
    with pytest.raises(ValueError, match="max_triangles"):
        reduced(mesh, 0)


def test_without_vtk_it_is_painted(monkeypatch, caplog):
    monkeypatch.setenv("GSNB_VTK", "none")
    for name in ("GSNB_SMOKE", "GSNB_VIEW"):
        monkeypatch.delenv(name, raising=False)
    gl.can_draw.cache_clear()
    try:
        loaded = "pyvista" in sys.modules
        output = show_mesh(sheet(11), size=(160, 120))
        assert output.data[:2] == b"\xff\xd8"  # a JPEG
        assert "GSNB_VTK=none" in caplog.text
        assert ("pyvista" in sys.modules) == loaded
        with pytest.raises(RuntimeError, match="html view needs VTK"):
            show_mesh(sheet(11), backend="html")
    finally:
        gl.can_draw.cache_clear()


def test_vtk_and_the_painter_agree():
    able, reason = gl.can_draw()
    if not able:
        pytest.skip(reason)
    mesh = sheet(41)
    T = orbit_camera((0, 0, 0), -60, 50, 2.0)
    vtk, painted = mesh_picture(mesh, T, size=(160, 120)), draw_mesh(mesh, CAMERA, T)
    same = np.abs(vtk.astype(int) - painted).max(-1) < 60
    assert same.mean() > 0.97
    assert (vtk == BACKGROUND).all(-1).mean() == pytest.approx((painted == BACKGROUND).all(-1).mean(), abs=0.02)


def test_an_empty_mesh_is_refused_with_a_reason():
    with pytest.raises(ValueError, match="no triangles"):
        show_mesh(Mesh(vertices_W=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.int64), rgb=torch.zeros(0, 3)))
