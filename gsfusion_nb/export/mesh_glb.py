"""A coloured triangle mesh as binary glTF, which web viewers and Blender open (Khronos glTF 2.0)."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..geometry.upright import Up, turn_to_y_up
from ..types import Mesh
from .glb import INDICES, GlbArrays, write_glb

MATERIAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
    "extensions": {"KHR_materials_unlit": {}},
}
"""Of colours that already contain the lighting."""


def write_mesh_glb(path: str | Path, mesh: Mesh, *, up: Up = "-y") -> None:
    """Write a mesh as one ``.glb`` file, atomically.

    glTF is right-handed with y up. Positions are rotated (``turn_to_y_up``): with ``up="-y"`` (a world frame with the
    OpenCV axes of the first camera) by (x, y, z) -> (x, -y, -z); with ``up="+z"`` (z up) by (x, y, z) -> (x, z, -y).
    These are rotations, so nothing is mirrored. Colours are stored as linear RGB, as glTF requires, with an unlit
    material, because they already contain the lighting. They are float32: 8 bits of linear RGB are too coarse for dark
    colours, and MeshLab and trimesh read 16-bit colours as 8-bit ones.

    Args:
        path: File to write.
        mesh: Mesh; an empty one gives a file with an empty scene (glTF has no empty meshes).
        up: Direction of the mesh's world that points up: the name of an axis, or three numbers.
    """
    R = turn_to_y_up(up)
    arrays = GlbArrays()
    document: dict[str, Any] = {"scenes": [{}]}
    if len(mesh.faces):
        document = {
            "extensionsUsed": ["KHR_materials_unlit"],
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [mesh_primitive(arrays, mesh, R)]}],
            "materials": [MATERIAL],
        }
    write_glb(path, document, arrays)


def mesh_primitive(arrays: GlbArrays, mesh: Mesh, R: torch.Tensor) -> dict[str, Any]:
    """Append a mesh turned by ``R``; returns the glTF primitive, whose material has the number 0."""
    xyz = mesh.vertices_W.detach().to("cpu", torch.float32) @ R.float().T
    linear = linear_from_srgb(mesh.rgb.detach().clamp(0, 1).cpu().double().numpy())
    attributes = {
        "POSITION": arrays.add(xyz.numpy().astype("<f4"), bounds=True),
        "COLOR_0": arrays.add(linear.astype("<f4")),
    }
    indices = arrays.add(mesh.faces.cpu().numpy().astype("<u4").reshape(-1), target=INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}


def linear_from_srgb(rgb: np.ndarray) -> np.ndarray:
    """Linear RGB values of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(rgb: np.ndarray) -> np.ndarray:
    """sRGB values of linear RGB values in 0..1: the inverse."""
    return np.where(rgb <= 0.0031308, rgb * 12.92, 1.055 * np.maximum(rgb, 0.0031308) ** (1 / 2.4) - 0.055)
