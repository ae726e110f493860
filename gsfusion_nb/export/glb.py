"""Gaussians and mesh in one binary glTF file, in one frame and right side up, for web viewers and
Blender (Khronos glTF 2.0 with ``KHR_gaussian_splatting``).

The extension (Khronos, ratified) stores Gaussians as attributes of points: scales in metres,
opacities 0..1, rotations xyzw, the coefficients of the colour one attribute each, in the signs and
the order of Kerbl et al. 2023. Colours are sRGB as they were trained. glTF has y up: the root node
has the rotation that takes the map there, and below it are the numbers of the map unchanged.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import ArgumentError
from ..files import atomic_file
from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0
from ..geometry.upright import Up, turn_to_y_up
from ..types import GaussianParams, Mesh

EXTENSION = "KHR_gaussian_splatting"
_KIND = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
_MATERIAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
    "extensions": {"KHR_materials_unlit": {}},
}
"""Of colours that already contain the lighting."""
_CODES = {"u1": 5121, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES = 34962
_INDICES = 34963
"""What an array is for: attributes of points, numbers of vertices."""


def write_map_glb(
    path: str | Path,
    gaussians: GaussianParams,
    mesh: Mesh | None = None,
    *,
    up: Up = "-y",
) -> None:
    """Write Gaussians, and a mesh if given, as one ``.glb`` file, atomically. Every Gaussian must
    be finite.

    The colours of the mesh are stored as linear RGB, as glTF requires, with an unlit material,
    because they already contain the lighting. They are float32: 8 bits of linear RGB are too coarse
    for dark colours.

    Args:
        path: File to write.
        gaussians: The map; may be empty.
        mesh: Its surface.
        up: Direction of the map's world that points up: the name of an axis, or three numbers.

    Raises:
        ValueError: a Gaussian with NaN or infinities.
    """
    check_gaussians(gaussians)
    arrays = _Arrays()
    nodes = []
    meshes = []
    used = []
    if len(gaussians):
        nodes.append({"name": "Gaussians", "mesh": len(meshes)})
        meshes.append({"primitives": [_splats(arrays, gaussians)]})
        used.append(EXTENSION)
    if mesh is not None and len(mesh.faces):
        nodes.append({"name": "surface", "mesh": len(meshes)})
        meshes.append({"primitives": [_surface(arrays, mesh)]})
        used.append("KHR_materials_unlit")
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "gsfusion_nb"},
        "scene": 0,
        "scenes": [{}],
    }
    if nodes:
        w, x, y, z = quaternion.from_matrix(turn_to_y_up(up)).tolist()
        root = {
            "name": "gsfusion_nb map",
            "rotation": [x, y, z, w],
            "children": list(range(1, len(nodes) + 1)),
        }
        document |= {
            "extensionsUsed": used,
            "scenes": [{"nodes": [0]}],
            "nodes": [root, *nodes],
            "meshes": meshes,
        }
        document |= {"materials": [_MATERIAL]} if "KHR_materials_unlit" in used else {}
        document |= {"accessors": arrays.accessors, "bufferViews": arrays.views}
        document["buffers"] = [{"byteLength": arrays.size}]
    text = json.dumps(document, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<I4s", arrays.size, b"BIN\0") if arrays.size else b""
    total = 12 + 8 + len(text) + len(chunk) + arrays.size
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(
            struct.pack("<4sII", b"glTF", 2, total)
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + chunk
        )
        for part in arrays.parts:
            file.write(part)


def check_gaussians(gaussians: GaussianParams) -> None:
    """Raise ``ValueError`` for Gaussians with NaN or infinities, which no viewer draws."""
    for name, column in vars(gaussians).items():
        if not bool(column.isfinite().all()):
            raise ArgumentError(
                f"{name} of {int((~column.isfinite()).any(-1).sum())} Gaussians is NaN or infinite"
            )


class _Arrays:
    """The arrays of a file that is being written."""

    def __init__(self):
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.parts: list[bytes] = []
        self.size = 0

    def add(
        self,
        values: np.ndarray,
        *,
        target: int = _VERTICES,
        bounds: bool = False,
        **more: bool,
    ) -> int:
        """Append an array [N, width] or [N] of float32, uint32 or uint8; returns the number of its
        accessor.

        ``bounds`` also stores the smallest and largest value of each column, as glTF wants it for
        positions.
        """
        code = _CODES[values.dtype.str[1:]]
        width = 1 if values.ndim == 1 else values.shape[1]
        entry = {
            "bufferView": len(self.views),
            "componentType": code,
            "count": len(values),
            "type": _TYPES[width],
        }
        entry |= more
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        raw = np.ascontiguousarray(values).tobytes()
        self.views.append(
            {"buffer": 0, "byteOffset": self.size, "byteLength": len(raw), "target": target}
        )
        self.accessors.append(entry)
        self.parts += [raw, b"\0" * (-len(raw) % 4)]
        self.size += len(raw) + (-len(raw) % 4)
        return len(self.accessors) - 1


def linear_rgb(rgb: torch.Tensor) -> np.ndarray:
    """Linear RGB values of sRGB values in 0..1 (IEC 61966-2-1), float64."""
    srgb = rgb.detach().double().clamp(0, 1).cpu().numpy()
    return np.where(
        srgb <= 0.04045,
        srgb / 12.92,
        ((srgb + 0.055) / 1.055) ** 2.4,
    )


def _floats(column: torch.Tensor) -> np.ndarray:
    return column.detach().to("cpu", torch.float32).contiguous().numpy()


def _surface(arrays: _Arrays, mesh: Mesh) -> dict[str, Any]:
    attributes = {
        "POSITION": arrays.add(_floats(mesh.vertices_W), bounds=True),
        "COLOR_0": arrays.add(linear_rgb(mesh.rgb).astype("<f4")),
    }
    indices = arrays.add(
        mesh.faces.cpu().numpy().astype("<u4").reshape(-1),
        target=_INDICES,
    )
    return {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}


def _splats(arrays: _Arrays, g: GaussianParams) -> dict[str, Any]:
    opacity = g.opacity_logit.double().sigmoid()
    sh = g.sh
    colour = linear_rgb(sh[:, 0].double() * SH_C0 + 0.5)
    # for programs without the extension
    points = np.concatenate([colour, opacity.cpu().numpy()[:, None]], axis=1)
    attributes = {
        "POSITION": arrays.add(_floats(g.xyz_W), bounds=True),
        "COLOR_0": arrays.add((points * 255).round().astype(np.uint8), normalized=True),
        f"{EXTENSION}:ROTATION": arrays.add(
            _floats(quaternion.normalise(g.quat.double())[:, [1, 2, 3, 0]])
        ),
        f"{EXTENSION}:SCALE": arrays.add(_floats(g.log_scale.double().exp())),
        f"{EXTENSION}:OPACITY": arrays.add(_floats(opacity)),
    }
    degrees = [(degree, n) for degree in range(4) for n in range(2 * degree + 1)]
    for k, (degree, n) in enumerate(degrees[: sh.shape[1]]):
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = arrays.add(_floats(sh[:, k]))
    return {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: dict(_KIND)}}
