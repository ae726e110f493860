"""Panels of chapters 1 to 3 that a page of the book computes by itself, without a kernel."""

import base64
import dataclasses
import json
import zlib
from pathlib import Path

import torch
from torch import Tensor

from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.viz.map_pictures import palette

PANELS = {"2e0433dd": "pixel", "5e44bd16": "fusion", "ac2f6900": "quadtree"}
"""Cell of a notebook -> the panel below it."""
_FOLDER = Path(__file__).parent / "live"


def panel_html(cell: str) -> str:
    """The panel below a cell, with what it shows in words; "" for most cells."""
    if cell not in PANELS:
        return ""
    text = (_FOLDER / f"{PANELS[cell]}.html").read_text(encoding="utf-8")
    script = f'<script defer src="../_static/live_{PANELS[cell]}.js"></script>'
    return (
        f'<section class="gsnb-live" id="live-{PANELS[cell]}">{text}<div></div></section>{script}'
    )


def panel_script(name: str) -> str:
    """What draws a panel: the formulas, the controls, the panel's own part, and its numbers."""
    data = f"const DATA = {json.dumps(panel_data(name))};\n"
    parts = [
        (_FOLDER / f"{part}.js").read_text(encoding="utf-8") for part in ("formulas", "panel", name)
    ]
    return (
        f"(() => {{\n{data}{''.join(parts)}start(document.querySelector('#live-{name} > "
        f"div'));\n}})();\n"
    )


def panel_data(name: str) -> dict[str, object]:
    """Frames of the built-in room, depth in 0.1 mm; of "fusion" the first one's exact depth, then
    those of a Kinect."""
    n_frames, width = {"pixel": (60, 160), "fusion": (240, 80), "quadtree": (60, 320)}[name]
    room = RoomSequence(n_frames=n_frames, width=width, height=width * 3 // 4)
    noisy = RoomSequence(n_frames=n_frames, width=width, height=width * 3 // 4, noise="kinect")
    frames = [room[0], room[2]] if name == "pixel" else [room[0]]
    measurements = [noisy[i] for i in range(16)] if name == "fusion" else []
    depths = (
        [f.depth_m for f in (*frames, *measurements)] if name != "quadtree" else [torch.zeros(0)]
    )
    return {
        "camera": dataclasses.asdict(room.camera),
        "poses": [frame.T_WC[:3].tolist() for frame in measurements or frames],
        "rgb": _packed([frame.rgb_u8 for frame in frames]),
        "depth": _packed([(depth_m * 1e4).round().to(torch.uint16) for depth_m in depths]),
        "colours": [f"rgb({r},{g},{b})" for r, g, b in palette("viridis")[::17]],
    }


def _packed(images: list[Tensor]) -> str:
    return base64.b64encode(zlib.compress(torch.stack(images).numpy().tobytes(), 9)).decode("ascii")
