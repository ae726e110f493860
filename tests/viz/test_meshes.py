"""Mesh views: drawn by VTK, decimated, and by the browser as by VTK."""

import base64
import json
import subprocess

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.types import Camera, Mesh
from gsfusion_nb.viz import meshes, orbit_camera, show_mesh
from gsfusion_nb.viz.display import WIDGET_MIME, joined
from gsfusion_nb.viz.meshes import BACKGROUND, MeshViewer, can_draw, decimated, mesh_picture

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
    """1 m wide, 2 m away, 223.9 px of focal length: 112 px, whichever way the camera's picture is cut."""
    image = mesh_picture(sheet(21), CAMERA, FROM_ABOVE)
    assert inside(image) == pytest.approx([60 - 56, 60 + 56, 80 - 56, 80 + 56], abs=1.5)
    assert image[60, 60].argmax() == 0
    assert image[60, 100].argmax() == 2
    assert (mesh_picture(sheet(3), CAMERA, FROM_BELOW) == BACKGROUND).all()  # seen from behind
    grey = mesh_picture(sheet(3), CAMERA, FROM_ABOVE, shading="shape")[60]
    assert np.ptp(grey[[60, 100]].astype(int)) < 6
    none = Mesh(vertices_W=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.int64), rgb=torch.zeros(0, 3))
    assert (mesh_picture(none, CAMERA, FROM_ABOVE) == BACKGROUND).all()


def test_reduction_keeps_extent_area_colours_and_sides():
    mesh = sheet(101)
    small = decimated(mesh, 2_000)
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
    assert decimated(mesh, 10**6) is mesh
    assert len(decimated(mesh, 1).faces) <= 1
    with pytest.raises(ValueError, match="max_triangles"):
        decimated(mesh, 0)


def test_without_vtk_a_picture_is_refused_and_the_live_view_is_there(watched, monkeypatch):
    monkeypatch.setattr(meshes, "can_draw", lambda: (False, "apt-get install libgl1"))
    with pytest.raises(RuntimeError, match="libgl1"):
        show_mesh(sheet(11), backend="static", size=(160, 120))
    data, _ = show_mesh(sheet(11))._repr_mimebundle_()
    assert WIDGET_MIME in data
    assert "libgl1" in data["text/plain"]


@pytest.fixture
def watched(monkeypatch):
    """Somebody looks at the notebook."""
    for name in ("GSNB_SMOKE", "GSNB_VIEW"):
        monkeypatch.delenv(name, raising=False)


def test_the_live_view_keeps_a_picture(watched, monkeypatch, vtk):
    viewer = show_mesh(sheet(101), max_triangles=500, size=(160, 120), shading="shape", up_W=[0, 0, 2])
    assert isinstance(viewer, MeshViewer)
    assert len(viewer.mesh.faces) <= 500
    assert (viewer.width, viewer.height, viewer.shading, viewer.up_W) == (160, 120, "shape", [0.0, 0.0, 1.0])
    data, _ = viewer._repr_mimebundle_()
    assert WIDGET_MIME in data
    jpeg = np.frombuffer(base64.b64decode(data["image/jpeg"]), np.uint8)
    image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR))
    assert image.shape == (120, 160, 3)
    assert np.abs(image.astype(int) - viewer.picture()[..., ::-1]).mean() < 3
    assert len(str(data)) < 40_000  # the mesh is not in it
    monkeypatch.setenv("GSNB_VIEW", "static")
    assert WIDGET_MIME not in viewer._repr_mimebundle_()[0]


def test_the_mesh_travels_when_a_view_opens(watched):
    mesh = sheet(4)
    viewer, sent = show_mesh(mesh), []
    viewer.send = lambda content, buffers: sent.append((content, buffers))
    viewer._heard(viewer, {"kind": "something else"}, [])
    assert sent == []
    viewer._heard(viewer, {"kind": "ready"}, [])
    ((content, (xyz, faces, rgb)),) = sent
    assert content == {"kind": "mesh"}
    assert np.frombuffer(xyz, np.float32).reshape(-1, 3) == pytest.approx(mesh.vertices_W.numpy())
    assert (np.frombuffer(faces, np.int32).reshape(-1, 3) == mesh.faces.numpy()).all()
    assert (np.frombuffer(rgb, np.uint8).reshape(-1, 3) == (mesh.rgb * 255).byte().numpy()).all()


_SCRIPT = """
import { readFileSync } from "node:fs";
const { xyz, faces, rgb, pose, intrinsics, size, shape, background } = JSON.parse(readFileSync(process.argv[2]));
const painter = new MeshPainter(Float32Array.from(xyz), Int32Array.from(faces), Uint8Array.from(rgb));
const view = viewOf(pose, intrinsics, ...size);
painter.draw(viewOf(pose, intrinsics, ...size, 0.5), shape, background);
const picture = painter.draw(view, shape, background);
const { pixels } = picture;
const [middle, corner] = [80.5, 0].map((x) => MeshPainter.depthAt(picture, x, 0.75 * x));
console.log(JSON.stringify({ pixels: [...pixels], middle, corner }));
"""


def drawn_by_the_browser(node, folder, mesh, T_WC, shading):
    data = {
        "xyz": mesh.vertices_W.flatten().tolist(), "faces": mesh.faces.flatten().tolist(),
        "rgb": (mesh.rgb * 255).flatten().int().tolist(), "pose": T_WC.flatten().tolist(),
        "intrinsics": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], "size": [CAMERA.width, CAMERA.height],
        "shape": shading == "shape", "background": list(BACKGROUND),
    }  # fmt: skip
    (folder / "mesh.json").write_text(json.dumps(data))
    (folder / "mesh.mjs").write_text(joined(("projection", "meshes/raster")) + _SCRIPT)
    done = subprocess.run([node, folder / "mesh.mjs", folder / "mesh.json"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    pixels = np.array(answer["pixels"], np.uint8).reshape(CAMERA.height, CAMERA.width, 4)
    assert (pixels[..., 3] == 255).all()
    return pixels[..., :3], answer


@pytest.mark.parametrize("shading", ["colour", "shape"])
def test_the_browser_draws_what_vtk_draws(node, tmp_path, shading, vtk):
    """Two squares, one 0.3 m above a part of the other, seen at an angle: order, lamp and colours."""
    low, high = sheet(41), sheet(41, ((0, 1.0, 0), (1.0, 1.0, 0)))
    both = Mesh(
        vertices_W=torch.cat([high.vertices_W * 0.5 + torch.tensor([0.1, 0, 0.3]), low.vertices_W]),
        faces=torch.cat([high.faces, low.faces + 41 * 41]), rgb=torch.cat([high.rgb, low.rgb]),
    )  # fmt: skip
    T = orbit_camera((0, 0, 0), -60, 50, 2.0)
    image, answer = drawn_by_the_browser(node, tmp_path, both, T, shading)
    drawn = mesh_picture(both, CAMERA, T, shading=shading)
    # VTK smooths edges, and its lamp shines along the axis: up to 1 - cos(18 deg) of the light less at the corners
    same = np.abs(image.astype(int) - drawn).max(-1) < (15 if shading == "colour" else 30)
    assert same.mean() > 0.97
    assert inside(image) == pytest.approx(inside(drawn), abs=1)
    assert drawn.std() > 20
    assert answer["corner"] is None
    assert 1.5 < answer["middle"] < 1.9  # the upper square
