"""Mesh files: PLY."""

import struct

import numpy as np
import plyfile
import pytest
import torch

from gsfusion_nb.export import read_mesh_ply, write_mesh_ply
from gsfusion_nb.types import Mesh


def tetrahedron():
    return Mesh(
        vertices_W=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]),
        faces=torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        rgb=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.4, 1.5]]),
    )


def empty():
    return Mesh(
        vertices_W=torch.zeros(0, 3),
        faces=torch.zeros(0, 3, dtype=torch.int64),
        rgb=torch.zeros(0, 3),
    )


def test_ply_bytes_literally(tmp_path):
    write_mesh_ply(tmp_path / "m.ply", tetrahedron())
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\n"
        b"element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    )
    data = (tmp_path / "m.ply").read_bytes()
    assert data[: len(header)] == header
    body = data[len(header) :]
    assert len(body) == 4 * 15 + 4 * 13  # shared vertices: 4, not 12
    assert body[3 * 15 : 4 * 15] == struct.pack("<3f3B", 0, 0, 3, 51, 102, 255)
    assert body[-13:] == struct.pack("<B3i", 3, 1, 2, 3)


@pytest.mark.parametrize(
    "mesh",
    [tetrahedron(), empty()],
    ids=["tetrahedron", "empty"],
)
def test_ply_round_trip(tmp_path, mesh):
    write_mesh_ply(tmp_path / "m.ply", mesh)
    back = read_mesh_ply(tmp_path / "m.ply")
    assert torch.equal(back.vertices_W, mesh.vertices_W)
    assert torch.equal(back.faces.long(), mesh.faces)
    assert back.rgb.shape == mesh.rgb.shape
    if len(mesh.rgb):
        assert (back.rgb - mesh.rgb.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6


def foreign_ply(path, faces, text=False):
    vertex = np.array(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)],
        dtype=[(a, "f8") for a in "xyz"],
    )
    face = np.empty(len(faces), dtype=[("vertex_index", object)])
    face["vertex_index"] = [np.array(f, dtype=np.int32) for f in faces]
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face"),
    ]
    plyfile.PlyData(elements, text=text).write(str(path))


@pytest.mark.parametrize("text", [False, True])
def test_reads_files_of_other_programs(tmp_path, text):
    foreign_ply(
        tmp_path / "m.ply",
        [[0, 1, 2], [1, 3, 2]],
        text,
    )
    mesh = read_mesh_ply(tmp_path / "m.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert torch.equal(mesh.rgb, torch.full((4, 3), 0.5))


def test_ply_errors_are_sentences(tmp_path):
    path = tmp_path / "m.ply"
    with pytest.raises(FileNotFoundError, match=r"m\.ply does not exist"):
        read_mesh_ply(path)
    foreign_ply(path, [[0, 1, 2], [0, 1, 3, 2]])
    with pytest.raises(ValueError, match="only triangles, got faces with 3, 4 vertices"):
        read_mesh_ply(path)
    write_mesh_ply(path, tetrahedron())
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match=r"m\.ply is not .*readable .*PLY file"):
        read_mesh_ply(path)
    path.write_bytes(b"\xff\xfe nothing")
    with pytest.raises(ValueError, match=r"m\.ply is not .*readable .*PLY file"):
        read_mesh_ply(path)


@pytest.mark.parametrize("bad", [4, -1])
def test_faces_must_refer_to_vertices(bad):
    mesh = tetrahedron()
    with pytest.raises(ValueError, match="faces must refer to vertices 0 to 3"):
        Mesh(
            vertices_W=mesh.vertices_W,
            faces=torch.tensor([[0, 1, bad]]),
            rgb=mesh.rgb,
        )
