"""Meshes and Gaussians as binary glTF, which web viewers and Blender open: a coloured mesh (Khronos glTF 2.0), or
Gaussians and mesh in one file, in one frame and right side up (``KHR_gaussian_splatting``).

The extension (Khronos, ratified) stores Gaussians as attributes of points: scales in metres, opacities 0..1, rotations
xyzw, the coefficients of the colour one attribute each, in the signs and the order of Kerbl et al. 2023. Colours are
sRGB as they were trained. glTF has y up: the root node has the rotation that takes the map there, and below it are the
numbers of the map unchanged.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..checks import shown
from ..files import SequenceError
from ..gaussians.rows import moved
from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0
from ..geometry.upright import Up, turn_to_y_up
from ..types import GaussianParams, Mesh
from .glb import INDICES, Glb, GlbArrays, Placed, placed_meshes, read_glb, up_in_file, write_glb
from .ply import check_ply_rows

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


EXTENSION = "KHR_gaussian_splatting"
ROOT = "gsfusion_nb map"
"""Name of the root node; what is below it is in the frame of the map."""
_KIND = {
    "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
    "sortingMethod": "cameraDistance",
}  # fmt: skip
_POINTS, _TRIANGLES = 0, 4
_NEAREST = 2.0**-24
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""


def write_map_glb(path: str | Path, gaussians: GaussianParams, mesh: Mesh | None = None, *, up: Up = "-y") -> None:
    """Write Gaussians, and a mesh if given, as one ``.glb`` file, atomically. Every Gaussian must be finite.

    Args:
        path: File to write.
        gaussians: The map; may be empty.
        mesh: Its surface.
        up: Direction of the map's world that points up: the name of an axis, or three numbers.

    Raises:
        ValueError: a Gaussian with NaN or infinities.
    """
    for name, column in vars(gaussians).items():
        if not bool(column.isfinite().all()):
            raise ValueError(f"{name} of {int((~column.isfinite()).any(-1).sum())} Gaussians is NaN or infinite")
    arrays, nodes, meshes = GlbArrays(), [], []
    if len(gaussians):
        nodes.append({"name": "Gaussians", "mesh": len(meshes)})
        meshes.append({"primitives": [_splat_primitive(arrays, gaussians)]})
    has_surface = False
    if mesh is not None and len(mesh.faces):
        has_surface = True
        nodes.append({"name": "surface", "mesh": len(meshes)})
        meshes.append({"primitives": [mesh_primitive(arrays, mesh, torch.eye(3))]})
    if not nodes:
        write_glb(path, {"scenes": [{}]}, arrays)
        return
    used = [EXTENSION] * bool(len(gaussians)) + ["KHR_materials_unlit"] * has_surface
    w, x, y, z = quaternion.from_matrix(turn_to_y_up(up)).tolist()
    root = {"name": ROOT, "rotation": [x, y, z, w], "children": list(range(1, len(nodes) + 1))}
    document = {"extensionsUsed": used, "scenes": [{"nodes": [0]}], "nodes": [root, *nodes], "meshes": meshes}
    write_glb(path, document | ({"materials": [MATERIAL]} if has_surface else {}), arrays)


def read_map_glb(path: str | Path) -> tuple[GaussianParams, Mesh]:
    """All Gaussians and triangles of a ``.glb`` file of this or another program; both may be empty.

    A file of ours comes back in the frame of the map; another one in glTF's, with y up.

    Raises:
        FileNotFoundError: no such file. ValueError: no binary glTF file, damaged, or with contents that cannot be read
            (a compressed array, Gaussians stretched differently along the axes); the message names the part.
    """
    glb = read_glb(path)
    splats: list[GaussianParams] = []
    surfaces: list[Mesh] = []
    for placed in placed_meshes(glb, frame_of_map=ROOT):
        for primitive in placed.primitives:
            if EXTENSION in (primitive.get("extensions") or {}):
                splats.append(_read_splats(glb, primitive, placed))
            elif primitive.get("mode", _TRIANGLES) == _TRIANGLES:
                surfaces.append(_read_triangles(glb, primitive, placed))
    return _joined_splats(splats), _joined_surfaces(surfaces)


def up_of_map_glb(path: str | Path) -> torch.Tensor:
    """The up direction in the frame in which ``read_map_glb`` returns this file. [3]"""
    up = up_in_file(read_glb(path), frame_of_map=ROOT)
    return torch.where((up - up.round()).abs() < 1e-6, up.round(), up)


def sh_names(coefficients: int) -> list[str]:
    """Names of the attributes of the first 1, 4, 9 or 16 coefficients."""
    degrees = [(l, n) for l in range(4) for n in range(2 * l + 1)]  # noqa: E741
    return [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}" for l, n in degrees[:coefficients]]  # noqa: E741


def _splat_primitive(arrays: GlbArrays, g: GaussianParams) -> dict[str, Any]:
    def floats(column: torch.Tensor) -> np.ndarray:
        return column.detach().to("cpu", torch.float32).contiguous().numpy()

    opacity, sh = g.opacity_logit.double().sigmoid(), g.sh
    colour = linear_from_srgb((sh[:, 0].double() * SH_C0 + 0.5).clamp(0, 1).cpu().numpy())
    points = np.concatenate([colour, opacity.cpu().numpy()[:, None]], axis=1)  # for programs without the extension
    attributes = {
        "POSITION": arrays.add(floats(g.xyz_W), bounds=True),
        "COLOR_0": arrays.add((points * 255).round().astype(np.uint8), normalised=True),
        f"{EXTENSION}:ROTATION": arrays.add(floats(quaternion.normalise(g.quat.double())[:, [1, 2, 3, 0]])),
        f"{EXTENSION}:SCALE": arrays.add(floats(g.log_scale.double().exp())),
        f"{EXTENSION}:OPACITY": arrays.add(floats(opacity)),
    }
    for k, name in enumerate(sh_names(sh.shape[1])):
        attributes[name] = arrays.add(floats(sh[:, k]))
    return {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: dict(_KIND)}}


def _read_splats(glb: Glb, primitive: dict[str, Any], placed: Placed) -> GaussianParams:
    attributes = _attributes(glb, primitive)
    names = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")), *sh_names(1)]
    lacking = [name for name in names if name not in attributes]
    if lacking:
        raise SequenceError(f"{glb.path} has Gaussians without {', '.join(lacking)}; compressed ones cannot be read")
    kind = primitive["extensions"][EXTENSION]
    if not isinstance(kind, dict) or kind.get("kernel", "ellipse") != "ellipse":
        raise SequenceError(f"{glb.path} has Gaussians with {shown(kind)}; expected the kernel 'ellipse'")
    degree = max(d for d in range(4) if d == 0 or f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in attributes)
    names += sh_names((degree + 1) ** 2)[1:]
    lacking = [name for name in names if name not in attributes]
    if lacking:
        raise SequenceError(f"{glb.path} has colours of degree {degree} without {', '.join(lacking)}")
    columns = [_rows(glb, attributes[name], name, w) for name, w in zip(names, (3, 4, 3, 1, *[3] * 16), strict=False)]
    if len({len(column) for column in columns}) != 1:
        raise SequenceError(f"{glb.path} has Gaussians whose attributes differ in length; it is damaged")
    xyz, rotation, scale, opacity, *sh = columns
    scale = scale * placed.scale if placed.scale != 1.0 else scale
    if bool((scale <= 0).any()) or bool((opacity < 0).any()) or bool((opacity > 1).any()):
        raise SequenceError(
            f"{glb.path} has Gaussians with scales <= 0 or opacities outside 0..1; expected both inside"
        )
    if str(kind.get("colorSpace", "")).startswith("lin_"):
        sh[0] = _srgb_dc(sh[0])
    read = GaussianParams(
        xyz_W=xyz * placed.scale if placed.scale != 1.0 else xyz,
        log_scale=scale.log(),
        quat=rotation[:, [3, 0, 1, 2]].contiguous(),
        opacity_logit=opacity[:, 0].double().clamp(_NEAREST, 1 - _NEAREST).logit().float(),
        sh=torch.stack(sh, dim=1),
    )
    return read if placed.is_identity else moved(read, placed.R, placed.t)


def _srgb_dc(sh_dc: torch.Tensor) -> torch.Tensor:
    """The constant coefficient of a colour that was trained in linear light, for sRGB."""
    rgb = srgb_from_linear((sh_dc.double() * SH_C0 + 0.5).clamp(0, 1).numpy())
    return ((torch.from_numpy(rgb) - 0.5) / SH_C0).float()


def _read_triangles(glb: Glb, primitive: dict[str, Any], placed: Placed) -> Mesh:
    attributes = _attributes(glb, primitive)
    if "POSITION" not in attributes:
        raise SequenceError(f"{glb.path} has triangles without POSITION; compressed ones cannot be read")
    xyz = _rows(glb, attributes["POSITION"], "POSITION", 3)
    rgb = torch.full_like(xyz, 0.5)
    if "COLOR_0" in attributes:
        colour = _rows(glb, attributes["COLOR_0"], "COLOR_0", 3, 4)[:, :3].clamp(0, 1)
        rgb = torch.from_numpy(srgb_from_linear(colour.double().numpy())).float()
    faces = torch.arange(len(xyz), dtype=torch.int32)
    if "indices" in primitive:
        numbers = glb.array(primitive["indices"], 1)
        if numbers.dtype.kind != "u" or (numbers.size and int(numbers.max()) >= len(xyz)):
            raise SequenceError(f"{glb.path} has triangles of vertices that do not exist; it is damaged")
        faces = torch.from_numpy(numbers.astype(np.int32).reshape(-1))
    faces = faces[: len(faces) // 3 * 3].reshape(-1, 3)
    if len(rgb) != len(xyz):
        raise SequenceError(f"{glb.path} has {len(rgb)} colours for {len(xyz)} vertices; it is damaged")
    if not placed.is_identity or placed.scale != 1.0:
        xyz = ((placed.scale * xyz.double()) @ placed.R.T + placed.t).float()
    return Mesh(vertices_W=xyz, faces=faces, rgb=rgb)


def _attributes(glb: Glb, primitive: dict[str, Any]) -> dict[str, Any]:
    attributes = primitive.get("attributes", {})
    if not isinstance(attributes, dict):
        raise SequenceError(f"{glb.path} has attributes {shown(attributes)}; expected an object")
    return attributes


def _rows(glb: Glb, index: object, name: str, *widths: int) -> torch.Tensor:
    """A finite attribute as float32."""
    values = glb.array(index, *widths).astype(np.float32)
    check_ply_rows(glb.path, name, values, ("x", "y", "z", "w"))
    return torch.from_numpy(values)


def _joined_splats(parts: list[GaussianParams]) -> GaussianParams:
    most = max((part.sh.shape[1] for part in parts), default=1)
    none = [torch.zeros(0, *tail) for tail in ((3,), (3,), (4,), (), (most, 3))]
    names = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
    padded = [{n: getattr(p, n) for n in names[:4]} | {"sh": _padded(p.sh, most)} for p in parts]
    return GaussianParams(
        **{n: torch.cat([empty, *(p[n] for p in padded)]) for n, empty in zip(names, none, strict=True)}
    )


def _padded(sh: torch.Tensor, coefficients: int) -> torch.Tensor:
    return torch.cat([sh, sh.new_zeros(len(sh), coefficients - sh.shape[1], 3)], dim=1)


def _joined_surfaces(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(part.vertices_W) for part in parts)])
    faces = [part.faces + int(start) for part, start in zip(parts, starts, strict=False)]
    empty = torch.zeros(0, 3)
    return Mesh(
        vertices_W=torch.cat([empty, *(part.vertices_W for part in parts)]),
        faces=torch.cat([torch.zeros(0, 3, dtype=torch.int32), *faces]),
        rgb=torch.cat([empty, *(part.rgb for part in parts)]),
    )
