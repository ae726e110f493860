"""Where the meshes of a glTF file are: the transforms of its nodes, from the root down (Khronos glTF 2.0, 3.5)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..errors import SequenceError, shown
from ..geometry import quaternion
from .glb import Glb

_DEEPEST = 64
_SKEW = 1e-3
"""Largest difference of the three scales of a node, as a share: Gaussians cannot be stretched."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A mesh of the file and its place: x -> scale R x + t."""

    primitives: list[dict[str, Any]]
    R: Tensor
    t: Tensor
    scale: float

    @property
    def is_identity(self) -> bool:
        """Whether nothing turns or moves."""
        return torch.equal(self.R, torch.eye(3).double()) and not bool(self.t.any())


def placed_meshes(glb: Glb, *, frame_of_map: str) -> Iterator[Placed]:
    """All meshes of the file's scene. The transform of a root node named ``frame_of_map`` is not applied.

    Raises:
        SequenceError: a node that is its own ancestor, or stretches more along one axis than along another.
    """
    scenes = glb.document.get("scenes")
    if isinstance(scenes, list) and scenes:
        roots = glb.item("scenes", glb.document.get("scene", 0)).get("nodes", [])
    else:
        roots = list(range(len(glb.document.get("nodes") or [])))
    seen: set[int] = set()
    todo = [(index, torch.eye(4, dtype=torch.float64), 0) for index in _list(glb, roots)]
    while todo:
        index, T_parent, depth = todo.pop(0)
        node = glb.item("nodes", index)
        if index in seen or depth > _DEEPEST:
            raise SequenceError(f"{glb.path} has a node {index} that is reached twice or too deep; it is damaged")
        seen.add(index)
        T = T_parent if depth == 0 and node.get("name") == frame_of_map else T_parent @ _transform(glb, node)
        if "mesh" in node:
            primitives = _list(glb, glb.item("meshes", node["mesh"]).get("primitives", []))
            if not all(isinstance(p, dict) for p in primitives):
                raise SequenceError(f"{glb.path}: the primitives of mesh {node['mesh']} must be objects")
            yield _placed(glb, index, primitives, T)
        todo += [(child, T, depth + 1) for child in _list(glb, node.get("children", []))]


def up_in_file(glb: Glb, *, frame_of_map: str) -> Tensor:
    """The up direction in the frame in which ``placed_meshes`` gives the meshes: glTF's y, seen from the map. [3]"""
    for node in _list(glb, glb.document.get("nodes", [])):
        if isinstance(node, dict) and node.get("name") == frame_of_map:
            return _transform(glb, node)[1, :3]
    return torch.tensor([0.0, 1, 0], dtype=torch.float64)


def _placed(glb: Glb, index: int, primitives: list[dict[str, Any]], T: Tensor) -> Placed:
    lengths = T[:3, :3].norm(dim=0)
    scale = float(lengths.mean())
    R = T[:3, :3] / max(scale, 1e-12)
    if not bool(((R.T @ R - torch.eye(3).double()).abs() < _SKEW).all()) or not float(torch.linalg.det(R)) > 0:
        raise SequenceError(f"{glb.path}: node {index} mirrors or stretches its mesh, got {T[:3, :3].tolist()}")
    return Placed(primitives=primitives, R=R, t=T[:3, 3], scale=1.0 if abs(scale - 1) < 1e-9 else scale)


def _transform(glb: Glb, node: dict[str, Any]) -> Tensor:
    if "matrix" in node:
        return _numbers(glb, node["matrix"], 16).view(4, 4).T
    T = torch.eye(4, dtype=torch.float64)
    x, y, z, w = _numbers(glb, node.get("rotation", [0, 0, 0, 1]), 4)
    T[:3, :3] = quaternion.to_matrix(torch.stack([w, x, y, z])) * _numbers(glb, node.get("scale", [1, 1, 1]), 3)
    T[:3, 3] = _numbers(glb, node.get("translation", [0, 0, 0]), 3)
    return T


def _numbers(glb: Glb, values: object, n: int) -> Tensor:
    if not isinstance(values, list) or len(values) != n or not all(type(v) in (int, float) for v in values):
        raise SequenceError(f"{glb.path} has a node with {shown(values)}; expected {n} numbers")
    return torch.tensor(values, dtype=torch.float64)


def _list(glb: Glb, values: object) -> list[Any]:
    if not isinstance(values, list):
        raise SequenceError(f"{glb.path} has {shown(values)} where a list is expected; it is damaged")
    return values
