"""Gaussians and mesh in one glTF file: axes and numbers."""

import json
import struct

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.export import write_map_glb
from gsfusion_nb.export.glb import EXTENSION
from gsfusion_nb.gaussians.rigid_motion import move_params
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.geometry.upright import turn_to_minus_y_up, turn_to_y_up
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams, Mesh

MESH = Mesh(
    vertices_W=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]),
    faces=torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3]], dtype=torch.int32),
    rgb=torch.tensor([[0.0, 0.02, 1], [0.2, 0.4, 0.6], [1, 0, 0], [0.2, 0.4, 1.5]]),
)


def some(n, degree, generator):
    def rand(*shape):
        return torch.randn(*shape, generator=generator)

    return GaussianParams(
        xyz_W=rand(n, 3) * 0.5 + torch.tensor([0.0, 0, 3]),
        log_scale=rand(n, 3) * 0.5 - 2,
        quat=rand(n, 4),
        opacity_logit=rand(n) * 2,
        sh=rand(n, (degree + 1) ** 2, 3) * 0.3,
    )


def parts(path):
    """Document and binary chunk; every size that the container names is right."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    document = json.loads(data[20 : 20 + size])
    rest = data[20 + size :]
    if rest:
        assert struct.unpack("<I4s", rest[:8]) == (len(rest) - 8, b"BIN\0")
        assert document["buffers"] == [{"byteLength": len(rest) - 8}]
    return document, rest[8:]


def array(document, chunk, index, dtype="<f4"):
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    data = chunk[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(data, dtype).reshape(entry["count"], -1)


def up_of_root(document):
    x, y, z, w = document["nodes"][0]["rotation"]
    return quaternion.to_matrix(torch.tensor([w, x, y, z]))[1]  # what glTF's y is in the map


def test_numbers_as_the_extension_has_them(tmp_path):
    one = GaussianParams(
        xyz_W=torch.tensor([[1.0, 2, 3]]),
        log_scale=torch.tensor([[0.01, 0.1, 1.0]]).log(),
        quat=torch.tensor([[0.0, 0, 0, 2]]),
        opacity_logit=torch.tensor([0.75]).logit(),
        sh=torch.arange(12.0).view(1, 4, 3),
    )
    write_map_glb(tmp_path / "m.glb", one, up="+z")
    document, chunk = parts(tmp_path / "m.glb")
    assert document["extensionsUsed"] == [EXTENSION]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"

    def values(name):
        return array(document, chunk, primitive["attributes"][name])[0]

    assert values("POSITION").tolist() == [1, 2, 3]
    assert values(f"{EXTENSION}:SCALE") == pytest.approx([0.01, 0.1, 1.0])  # metres, no logarithms
    assert values(f"{EXTENSION}:ROTATION").tolist() == [0, 0, 1, 0]  # xyzw
    assert values(f"{EXTENSION}:OPACITY")[0] == pytest.approx(0.75)  # after the sigmoid
    assert values(f"{EXTENSION}:SH_DEGREE_1_COEF_2").tolist() == [9, 10, 11]
    assert torch.allclose(
        up_of_root(document),
        torch.tensor([0.0, 0, 1]),
        atol=1e-6,
    )


def test_mesh_beside_the_gaussians(tmp_path, generator):
    write_map_glb(tmp_path / "m.glb", some(7, 3, generator), MESH)
    document, chunk = parts(tmp_path / "m.glb")
    assert torch.allclose(
        up_of_root(document),
        torch.tensor([0.0, -1, 0]),
        atol=1e-6,
    )
    assert [document["nodes"][i]["name"] for i in document["nodes"][0]["children"]] == [
        "Gaussians",
        "surface",
    ]
    primitive = document["meshes"][1]["primitives"][0]
    xyz, colour = (primitive["attributes"][name] for name in ("POSITION", "COLOR_0"))
    assert array(document, chunk, xyz).tolist() == MESH.vertices_W.tolist()
    assert (document["accessors"][xyz]["min"], document["accessors"][xyz]["max"]) == (
        [0, 0, 0],
        [1, 2, 3],
    )
    assert (
        array(document, chunk, primitive["indices"], "<u4").reshape(-1, 3).tolist()
        == MESH.faces.tolist()
    )
    # 0.2 and 0.4 of sRGB are 0.0331 and 0.1329 of linear light
    assert array(document, chunk, colour)[3].tolist() == pytest.approx(
        [0.03310, 0.13287, 1.0], abs=1e-5
    )


@pytest.mark.parametrize("degree", [1, 3])
def test_a_moved_map_looks_the_same_from_the_moved_camera(generator, degree):
    g = some(60, degree, generator)
    camera = Camera(
        width=48,
        height=32,
        fx=40.0,
        fy=40.0,
        cx=24.0,
        cy=16.0,
    )
    R = turn_to_minus_y_up((0.2, 0.9, 0.4))
    t = torch.tensor([0.5, -1.0, 2.0])
    T = torch.eye(4)
    T[:3, :3] = R.float()
    T[:3, 3] = t
    with use_backend("reference"):
        before = render(g, camera, torch.eye(4)).rgb
        after = render(move_params(g, R, t), camera, T).rgb
    assert before.std() > 0.05
    assert torch.allclose(before, after, atol=2e-4)


def test_up_is_turned_to_y_by_a_rotation():
    for up in ("+x", "-x", "+y", "-y", "+z", "-z", (1.0, 2.0, -3.0)):
        R = turn_to_y_up(up)
        u = torch.tensor(up).double() if isinstance(up, tuple) else torch.linalg.inv(R)[:, 1]
        assert torch.allclose(
            R @ u / u.norm(),
            torch.tensor([0.0, 1, 0]).double(),
        )
        assert float(torch.linalg.det(R)) == pytest.approx(1.0)
    assert turn_to_y_up("-y").diag().tolist() == [1, -1, -1]
    with pytest.raises(ValueError, match="direction of three numbers"):
        turn_to_y_up((0.0, 0.0, 0.0))


def test_nothing_is_an_empty_scene_and_what_is_not_finite_is_refused(tmp_path, generator):
    write_map_glb(tmp_path / "m.glb", some(0, 3, generator))
    document, chunk = parts(tmp_path / "m.glb")
    assert (document["scenes"], chunk) == ([{}], b"")
    bad = move_params(
        some(1, 0, generator),
        torch.eye(3),
        torch.tensor([0, 0, float("nan")]),
    )
    with pytest.raises(ValueError, match="xyz_W of 1 Gaussians"):
        write_map_glb(tmp_path / "n.glb", bad)
