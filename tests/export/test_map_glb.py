"""Gaussians and mesh in one glTF file: axes, numbers, other programs' ways to write them, damaged files."""

import json
import struct

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.export import read_map_glb, write_map_glb
from gsfusion_nb.export.map_glb import EXTENSION
from gsfusion_nb.gaussians.rows import moved
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.geometry.upright import turn_to_minus_y_up, turn_to_y_up
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams, Mesh

MESH = Mesh(
    vertices_W=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]),
    faces=torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3]], dtype=torch.int32),
    rgb=torch.tensor([[0.0, 0.02, 1], [0.2, 0.4, 0.6], [1, 0, 0], [0.5, 0.5, 0.5]]),
)


def some(n, degree, generator):
    def rand(*shape):
        return torch.randn(*shape, generator=generator)

    return GaussianParams(
        xyz_W=rand(n, 3) * 0.5 + torch.tensor([0.0, 0, 3]), log_scale=rand(n, 3) * 0.5 - 2, quat=rand(n, 4),
        opacity_logit=rand(n) * 2, sh=rand(n, (degree + 1) ** 2, 3) * 0.3,
    )  # fmt: skip


def parts(path):
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def rewritten(path, change):
    """The file with ``change(document)`` applied."""
    document, chunk = parts(path)
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(chunk), b"BIN\0") + chunk
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_comes_back_in_the_frame_of_the_map(tmp_path, generator, degree):
    g = some(7, degree, generator)
    write_map_glb(tmp_path / "m.glb", g, MESH, up="+z")
    back, mesh = read_map_glb(tmp_path / "m.glb")
    assert torch.equal(back.xyz_W, g.xyz_W)
    assert torch.equal(back.sh, g.sh)
    assert torch.allclose(back.log_scale, g.log_scale, atol=1e-6)
    assert torch.allclose(back.opacity_logit, g.opacity_logit, atol=1e-5)
    assert torch.allclose(back.quat, quaternion.normalise(g.quat), atol=1e-6)
    assert torch.equal(mesh.vertices_W, MESH.vertices_W)
    assert torch.equal(mesh.faces, MESH.faces)
    assert torch.allclose(mesh.rgb, MESH.rgb, atol=1e-6)


def test_numbers_as_the_extension_has_them(tmp_path):
    one = GaussianParams(
        xyz_W=torch.tensor([[1.0, 2, 3]]), log_scale=torch.tensor([[0.01, 0.1, 1.0]]).log(),
        quat=torch.tensor([[0.0, 0, 0, 2]]), opacity_logit=torch.tensor([0.75]).logit(),
        sh=torch.arange(12.0).view(1, 4, 3),
    )  # fmt: skip
    write_map_glb(tmp_path / "m.glb", one, up="+z")
    document, chunk = parts(tmp_path / "m.glb")
    assert document["extensionsUsed"] == [EXTENSION]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"

    def values(name):
        entry = document["accessors"][primitive["attributes"][name]]
        start = document["bufferViews"][entry["bufferView"]]["byteOffset"]
        return np.frombuffer(chunk[start : start + 16], "<f4")

    assert values("POSITION")[:3].tolist() == [1, 2, 3]
    assert values(f"{EXTENSION}:SCALE")[:3] == pytest.approx([0.01, 0.1, 1.0])  # metres, no logarithms
    assert values(f"{EXTENSION}:ROTATION").tolist() == [0, 0, 1, 0]  # xyzw
    assert values(f"{EXTENSION}:OPACITY")[0] == pytest.approx(0.75)  # after the sigmoid
    assert values(f"{EXTENSION}:SH_DEGREE_1_COEF_2")[:3].tolist() == [9, 10, 11]
    root = document["nodes"][0]
    x, y, z, w = root["rotation"]
    up = quaternion.to_matrix(torch.tensor([w, x, y, z])) @ torch.tensor([0.0, 0, 1])
    assert torch.allclose(up, torch.tensor([0.0, 1, 0]), atol=1e-6)  # the map's z is glTF's y


def test_a_file_with_other_nodes_is_moved(tmp_path, generator):
    g = some(20, 3, generator)
    write_map_glb(tmp_path / "m.glb", g, MESH, up="+y")
    R, t = turn_to_y_up((0.3, -0.2, 0.7)), torch.tensor([1.0, 2.0, 3.0])
    w, x, y, z = quaternion.from_matrix(R).tolist()

    def change(document):
        document["nodes"][0] = {
            "children": [1, 2], "rotation": [x, y, z, w], "translation": t.tolist(), "scale": [2, 2, 2],
        }  # fmt: skip

    rewritten(tmp_path / "m.glb", change)
    back, mesh = read_map_glb(tmp_path / "m.glb")
    wanted = moved(g, R, t, scale=2.0)
    assert torch.allclose(back.xyz_W, wanted.xyz_W, atol=1e-5)
    assert torch.allclose(back.sh, wanted.sh, atol=1e-5)
    assert torch.allclose(back.log_scale, wanted.log_scale, atol=1e-5)
    assert torch.allclose(mesh.vertices_W, 2 * MESH.vertices_W @ R.float().T + t, atol=1e-5)


@pytest.mark.parametrize("degree", [1, 3])
def test_a_moved_map_looks_the_same_from_the_moved_camera(generator, degree):
    g = some(60, degree, generator)
    camera = Camera(width=48, height=32, fx=40.0, fy=40.0, cx=24.0, cy=16.0)
    R, t = turn_to_minus_y_up((0.2, 0.9, 0.4)), torch.tensor([0.5, -1.0, 2.0])
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = R.float(), t
    with use_backend("reference"):
        before = render(g, camera, torch.eye(4)).rgb
        after = render(moved(g, R, t), camera, T).rgb
    assert before.std() > 0.05
    assert torch.allclose(before, after, atol=2e-4)


def test_up_is_turned_to_y_by_a_rotation():
    for up in ("+x", "-x", "+y", "-y", "+z", "-z", (1.0, 2.0, -3.0)):
        R = turn_to_y_up(up)
        u = torch.tensor(up).double() if isinstance(up, tuple) else torch.linalg.inv(R)[:, 1]
        assert torch.allclose(R @ u / u.norm(), torch.tensor([0.0, 1, 0]).double())
        assert float(torch.linalg.det(R)) == pytest.approx(1.0)
    assert turn_to_y_up("-y").diag().tolist() == [1, -1, -1]
    with pytest.raises(ValueError, match="direction of three numbers"):
        turn_to_y_up((0.0, 0.0, 0.0))


def test_nothing_is_an_empty_scene(tmp_path, generator):
    write_map_glb(tmp_path / "m.glb", some(0, 3, generator))
    back, mesh = read_map_glb(tmp_path / "m.glb")
    assert len(back) == len(mesh.faces) == 0
    with pytest.raises(ValueError, match="xyz_W of 1 Gaussians is NaN"):
        write_map_glb(
            tmp_path / "n.glb", moved(some(3, 0, generator), torch.eye(3), torch.tensor([0, 0, float("nan")]))[:1]
        )


def without(name):
    return lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(name)


DAMAGES = {
    "has Gaussians without KHR_gaussian_splatting:SCALE": without(f"{EXTENSION}:SCALE"),
    "degree 3 without .*SH_DEGREE_2_COEF_1": without(f"{EXTENSION}:SH_DEGREE_2_COEF_1"),
    "reaches outside the file's binary part": lambda d: d["bufferViews"][0].update(byteLength=4),
    "refers to entry 99 of accessors": lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(POSITION=99),
    "must be a plain array with 3 numbers": lambda d: d["accessors"][0].update(type="VEC2"),
    "attributes differ in length": lambda d: d["accessors"][0].update(count=5),
    "node 1 that is reached twice": lambda d: d["nodes"][1].update(children=[1]),
    "mirrors or stretches": lambda d: d["nodes"][1].update(scale=[1, 2, 1]),
    "has a node with 'up'; expected 4 numbers": lambda d: d["nodes"][1].update(rotation="up"),
    "expected the kernel 'ellipse'": lambda d: d["meshes"][0]["primitives"][0]["extensions"][EXTENSION].update(
        kernel="disc"
    ),
}


@pytest.mark.parametrize("sentence", DAMAGES)
def test_damaged_files_are_named(tmp_path, generator, sentence):
    write_map_glb(tmp_path / "m.glb", some(6, 3, generator), MESH)
    rewritten(tmp_path / "m.glb", DAMAGES[sentence])
    with pytest.raises(ValueError, match=rf"m\.glb.*{sentence}"):
        read_map_glb(tmp_path / "m.glb")


def test_truncated_and_foreign_files(tmp_path, generator):
    path = tmp_path / "m.glb"
    with pytest.raises(FileNotFoundError, match=r"m\.glb does not exist"):
        read_map_glb(path)
    write_map_glb(path, some(6, 3, generator))
    whole = path.read_bytes()
    for n in (3, 30, len(whole) - 5):
        path.write_bytes(whole[:n])
        with pytest.raises(ValueError, match=r"m\.glb is truncated"):
            read_map_glb(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(ValueError, match="does not begin like binary glTF"):
        read_map_glb(path)
