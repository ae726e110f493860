"""A coloured triangle mesh as binary glTF, which web viewers and Blender open (Khronos glTF 2.0, section 4.4)."""

import json
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ..checks import check_name
from ..files import write_file
from ..types import Mesh

_TO_Y_UP = {
    "-y": torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "+z": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "+y": torch.eye(3),
}
_FLOAT, _UINT = 5126, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963


def write_mesh_glb(path: str | Path, mesh: Mesh, *, up: Literal["-y", "+z", "+y"] = "-y") -> None:
    """Write a mesh as one ``.glb`` file, atomically.

    glTF is right-handed with y up. Positions are rotated: with ``up="-y"`` (a world frame with the OpenCV axes of the
    first camera) by (x, y, z) -> (x, -y, -z); with ``up="+z"`` (z up) by (x, y, z) -> (x, z, -y). Both are rotations,
    so nothing is mirrored. Colours are stored as linear RGB, as glTF requires, with an unlit material, because they
    already contain the lighting. They are float32: 8 bits of linear RGB are too coarse for dark colours, and MeshLab
    and trimesh read 16-bit colours as 8-bit ones.

    Args:
        path: File to write.
        mesh: Mesh; an empty one gives a file with an empty scene (glTF has no empty meshes).
        up: Axis of the mesh's world that points up.
    """
    check_name("up axis", up, _TO_Y_UP)
    empty = mesh.faces.shape[0] == 0
    positions, colours, indices = _buffers(mesh, up)
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "gsfusion_nb"}, "scene": 0}
    if empty:
        document["scenes"] = [{}]
        chunk = b""
    else:
        chunk = positions.tobytes() + colours.tobytes() + indices.tobytes()
        document |= _document(positions, colours, indices)
    write_file(path, _container(document, chunk))


def linear_from_srgb(rgb: np.ndarray) -> np.ndarray:
    """Linear RGB values of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def _buffers(mesh: Mesh, up: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    xyz = mesh.vertices_W.detach().to("cpu", torch.float32) @ _TO_Y_UP[up].T
    linear = linear_from_srgb(mesh.rgb.detach().clamp(0, 1).cpu().double().numpy())
    return xyz.numpy().astype("<f4"), linear.astype("<f4"), mesh.faces.cpu().numpy().astype("<u4").reshape(-1)


def _document(positions: np.ndarray, colours: np.ndarray, indices: np.ndarray) -> dict[str, Any]:
    sizes = [positions.nbytes, colours.nbytes, indices.nbytes]
    targets = [_VERTEX_DATA, _VERTEX_DATA, _INDEX_DATA]
    views = [
        {"buffer": 0, "byteOffset": sum(sizes[:i]), "byteLength": sizes[i], "target": targets[i]} for i in range(3)
    ]
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors = [
        {"bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3", **bounds},
        {"bufferView": 1, "componentType": _FLOAT, "count": len(colours), "type": "VEC3"},
        {"bufferView": 2, "componentType": _UINT, "count": len(indices), "type": "SCALAR"},
    ]
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0, "mode": 4}
    return {
        "extensionsUsed": ["KHR_materials_unlit"],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(sizes)}],
    }


def _container(document: dict[str, Any], chunk: bytes) -> bytes:
    """The GLB container: header, JSON chunk padded with spaces, binary chunk padded with zeros."""
    text = json.dumps(document, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    chunk += b"\0" * (-len(chunk) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text
    if chunk:
        parts += struct.pack("<I4s", len(chunk), b"BIN\0") + chunk
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts
