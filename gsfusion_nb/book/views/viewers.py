"""The splat viewer and the mesh viewer with their data: the browser draws them, as in the notebook."""

import base64
import json
from typing import Any

import numpy as np

from ...drawing.pictures import to_uint8
from ...viz.live.orbit import OrbitView
from ...viz.meshes.picture import decimated
from ...viz.meshes.viewer import MeshViewer
from ...viz.splats.packed_rows import RowLayout, pack_rows
from ...viz.splats.viewer import SplatViewer
from .recorded import Recorded

HARMONICS = 4
"""Coefficients of the colour in the book, at most: degree 1. The files are half as large."""
TRIANGLES = 40_000
"""Of a mesh in the book, at most."""
_NOT_OF_THE_VIEW = ("layout", "tabbable", "tooltip", "comm", "stats")


def record_splats(viewer: SplatViewer) -> Recorded:
    """A Gaussian map that can be turned."""
    params, columns = viewer.shown()
    layout = RowLayout(columns=columns.shape[1], harmonics=min(HARMONICS, params.sh.shape[1]))
    rows = pack_rows(params, columns, layout)
    head = {
        "n": len(rows),
        "stride": layout.stride,
        "columns": layout.columns,
        "harmonics": layout.harmonics,
        "all": True,
    }
    data = {"traits": _traits(viewer), "head": head, "buffers": [_text(rows)]}
    words = f"The map with its {len(rows):,} Gaussians: drag to turn it, click a Gaussian for its numbers."
    if params.sh.shape[1] > layout.harmonics:
        words += " Colours change with the view as far as degree 1 here."
    return Recorded(kind="splat", data=data, words=words)


def record_orbit(view: OrbitView) -> Recorded:
    """The map of an orbit view, in the splat viewer."""
    return record_splats(view.splats())


def record_mesh(viewer: MeshViewer) -> Recorded:
    """A mesh that can be turned."""
    mesh = decimated(viewer.mesh, TRIANGLES)
    rgb = to_uint8(mesh.rgb[None])[0]
    arrays = (mesh.vertices_W.cpu().float().numpy(), mesh.faces.int().cpu().numpy(), rgb)
    data = {"traits": _traits(viewer), "buffers": [_text(np.ascontiguousarray(a)) for a in arrays]}
    words = f"The mesh with {len(mesh.faces):,} of its {len(viewer.mesh.faces):,} triangles: drag to turn it."
    if len(mesh.faces) == len(viewer.mesh.faces):
        words = f"The mesh with its {len(mesh.faces):,} triangles: drag to turn it."
    return Recorded(kind="mesh", data=data, words=words)


def _traits(viewer: Any) -> dict[str, Any]:
    """The values that the viewer's script asks its model for."""
    found = {}
    for name, value in viewer.get_state().items():
        if name.startswith("_") or name in _NOT_OF_THE_VIEW:
            continue
        try:
            found[name] = json.loads(json.dumps(value))
        except TypeError:
            continue
    return found


def _text(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
