"""Pictures of meshes, drawn by VTK."""

import numpy as np
import pytest
import torch

from gsfusion_nb.types import Camera, Mesh
from gsfusion_nb.viz import meshes, orbit_camera, show_mesh
from gsfusion_nb.viz.meshes import BACKGROUND, can_draw, mesh_picture

CAMERA = Camera(
    width=160,
    height=120,
    fx=223.923,
    fy=223.923,
    cx=80.0,
    cy=60.0,
)


def sheet(
    n=2,
    colours=((1.0, 0, 0), (0, 0, 1.0)),
):
    """A square of 1 m in the plane z = 0, facing +z, n x n vertices, first colour at x < 0, second
    at x > 0."""
    line = torch.linspace(-0.5, 0.5, n)
    x, y = torch.meshgrid(line, line, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    i = torch.arange(n * n).reshape(n, n)
    a = i[:-1, :-1].flatten()
    b = i[1:, :-1].flatten()
    c = i[1:, 1:].flatten()
    d = i[:-1, 1:].flatten()
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    left, right = (torch.tensor(c) for c in colours)
    return Mesh(
        vertices_W=vertices,
        faces=faces,
        rgb=torch.where((vertices[:, :1] < 0), left, right),
    )


FROM_ABOVE = orbit_camera((0, 0, 0), -90, 90, 2.0)  # +y up in the picture, +x right
FROM_BELOW = orbit_camera((0, 0, 0), -90, -90, 2.0)


@pytest.fixture
def vtk():
    """Skips where VTK cannot draw."""
    able, reason = can_draw()
    if not able:
        pytest.skip(reason)


def inside(image):
    """First and last row, then first and last column, of what is not background."""
    rows, columns = np.nonzero((image != BACKGROUND).any(-1))
    return [rows.min(), rows.max(), columns.min(), columns.max()]


def test_a_square_lies_where_the_camera_sees_it(vtk):
    """1 m wide, 2 m away, 223.9 px of focal length: 112 px, whichever way the camera's picture is
    cut."""
    image = mesh_picture(sheet(21), CAMERA, FROM_ABOVE)
    assert inside(image) == pytest.approx([60 - 56, 60 + 56, 80 - 56, 80 + 56], abs=1.5)
    assert image[60, 60].argmax() == 0
    assert image[60, 100].argmax() == 2
    assert (mesh_picture(sheet(3), CAMERA, FROM_BELOW) == BACKGROUND).all()  # seen from behind
    grey = mesh_picture(sheet(3), CAMERA, FROM_ABOVE, shading="shape")[60]
    assert np.ptp(grey[[60, 100]].astype(int)) < 6
    none = Mesh(
        vertices_W=torch.zeros(0, 3),
        faces=torch.zeros(0, 3, dtype=torch.int64),
        rgb=torch.zeros(0, 3),
    )
    assert (mesh_picture(none, CAMERA, FROM_ABOVE) == BACKGROUND).all()


def test_a_picture_of_a_mesh_says_what_it_shows(monkeypatch):
    drawn = np.zeros((120, 160, 3), np.uint8)
    monkeypatch.setattr(meshes, "mesh_picture", lambda *_, **__: drawn)
    words = "A mesh of 200 triangles, in its colours, seen from above at an angle"
    assert show_mesh(sheet(11), size=(160, 120)).alt == words
    grey = show_mesh(sheet(11), T_WC=FROM_ABOVE, size=(160, 120), shading="shape")
    assert grey.alt == "A mesh of 200 triangles, as a grey surface"


def test_without_vtk_a_picture_is_refused(monkeypatch):
    monkeypatch.setattr(meshes, "can_draw", lambda: (False, "apt-get install libgl1"))
    with pytest.raises(RuntimeError, match="libgl1"):
        show_mesh(sheet(11), size=(160, 120))
