"""The microscopes: of a pixel and of its mix, computed in the page; of its gradient, recorded over a grid of pixels."""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ...drawing.pictures import Picture, encode_png
from ...viz.microscopes.gradient_microscope import PICKS, PICTURE_PX, GradientMicroscope
from ...viz.microscopes.mix_microscope import MixMicroscope
from ...viz.microscopes.pixel_microscope import PICTURE_PX as SHOWN_PX
from ...viz.microscopes.pixel_microscope import PixelMicroscope
from ...viz.microscopes.pixel_stack import Splats
from ...viz.panels.trace import FOLLOWS, TracePanel
from .panels import counts_of, record_grids
from .recorded import Recorded, some, webp

PIXELS = (("u:9", "v:7"),)
"""Pixels of the gradient microscope that are recorded, columns and rows."""


def record_microscope(microscope: PixelMicroscope) -> Recorded:
    """Every pixel: the page gets the Gaussians on the screen and blends them itself."""
    camera = microscope.splats.camera
    values = splat_rows(microscope.splats)
    data = {
        "splats": base64.b64encode(values.tobytes()).decode("ascii"),
        "picture": base64.b64encode(encode_png(microscope.image, 9)).decode("ascii"),
        "width": camera.width,
        "height": camera.height,
        "shown": round(camera.width * SHOWN_PX / camera.height),
        "pixel": [microscope.stack.u, microscope.stack.v],
    }
    words = f"Click or drag on the picture: this page blends the {len(values):,} Gaussians in view itself."
    return Recorded(kind="pixels", data=data, words=words)


def record_mix(microscope: MixMicroscope) -> Recorded:
    """Every pixel: the page gets the surface, too, and mixes itself."""
    recorded = record_microscope(microscope)
    base = microscope.below.base
    below = torch.cat([base.rgb, base.depth_m[..., None], base.weight[..., None]], 2).cpu().float().numpy()
    recorded.data |= {
        "below": base64.b64encode(below.tobytes()).decode("ascii"),
        "behind": microscope.below.behind_m,
    }
    recorded.words = "Click or drag on the picture: this page mixes the surface and the Gaussians of the pixel itself."
    return recorded


def splat_rows(splats: Splats) -> np.ndarray:
    """What ``pixel_stack.js`` reads: the Gaussians whose box reaches into the picture, nearest first, float32. [N, 11]

    Columns: u, v, the conic's A, B, C, opacity, depth in metres, red, green, blue, row in the map.
    """
    p, camera = splats.projection, splats.camera
    size = p.uv.new_tensor([camera.width, camera.height])
    inside = p.visible & ((p.uv + p.extent_px >= 0) & (p.uv - p.extent_px <= size)).all(1)
    row = inside.nonzero().squeeze(1)
    row = row[p.depth_m[row].argsort(stable=True)]
    if len(row) and int(row.max()) >= 2**24:
        raise ValueError(f"row {int(row.max())} of the map is not exact in 32 bits; record a map below 16 million rows")
    one = [p.opacity[row, None], p.depth_m[row, None], splats.rgb[row], row[:, None].to(p.uv)]
    return torch.cat([p.uv[row], p.conic[row], *one], 1).detach().cpu().float().numpy()


def record_gradients(microscope: GradientMicroscope, grids: Sequence[Sequence[str]] = ()) -> Recorded:
    """Some pixels, with both picks; a click goes to the nearest of them."""
    camera = microscope.splats.camera
    across, down = counts_of(grids or PIXELS, ("u", "v"))
    u, v = (microscope.of_pixel.stack.u, microscope.of_pixel.stack.v)
    places = {"u": _spread(camera.width, across, u), "v": _spread(camera.height, down, v)}
    picked = microscope.pick

    def at(chosen: Mapping[str, int]) -> tuple[Picture, str, str]:
        microscope.look_at(places["u"][chosen["u"]], places["v"][chosen["v"]])
        microscope.pick = PICKS[chosen["pick"]]
        return microscope.picture(), microscope.numbers.value, f"{microscope.clicks.alt}; {microscope.arrows.alt}"

    controls = [
        {"name": "pick", "label": "a click picks", "words": list(PICKS), "start": PICKS.index(picked), "kind": "choice"}
    ]
    for name, label, start in (("u", "column", u), ("v", "row", v)):
        words = [str(place) for place in places[name]]
        controls.append(
            {"name": name, "label": label, "words": words, "start": words.index(str(start)), "kind": "slider"}
        )
    recorded = record_grids(at, controls, [["pick", "u", "v"]], drawing=True)
    microscope.look_at(u, v).pick = picked
    height, width = microscope.picture().shape[:2]
    first = round(camera.width * PICTURE_PX / camera.height)
    recorded.data |= {
        "label": "The gradient microscope",
        "width": width,
        "click": {
            "controls": ["u", "v"],
            "places": [places["u"], places["v"]],
            "area": [0, (height - PICTURE_PX) / height, first / width, 1],
            "size": [camera.width, camera.height],
        },
    }
    recorded.words = (
        f"Recorded for {across} x {down} pixels: click the picture at the left, and the nearest of them is shown."
    )
    return recorded


def _spread(length: int, count: int, present: int) -> list[int]:
    """Places from end to end, evenly spread; the nearest one is moved to the present place."""
    found = [round((k + 0.5) * length / count) for k in range(count)]
    found[min(range(count), key=lambda k: abs(found[k] - present))] = present
    return found


TRACE_PIXELS = (("u:3", "v:2"),)
"""Pixels that can be clicked, columns and rows."""
MOST_PICTURES = 360
"""Of all stories together; of a longer story, some moments are left out."""
MOST_MOMENTS = 60
"""Of the story that the chapter shows."""


def record_trace(panel: TracePanel, grids: Sequence[Sequence[str]] = ()) -> Recorded:
    """The story that a panel shows, and those of a few pixels of the picture: each pixel's own, its heaviest Gaussian's
    and that of the voxel at its surface."""
    across, down = counts_of(grids or TRACE_PIXELS, ("u", "v"))
    at, follows = panel.slider.value, panel.follows
    first = panel.story
    width, height = panel.clicks.size
    stories = {panel.name: first}
    clicks: dict[str, list[list[Any]]] = {}
    for kind in FOLLOWS:
        for k in range(across * down):
            u, v = (k % across + 0.5) * width / across, (k // across + 0.5) * height / down
            panel.show_story(first, next(iter(stories)), at)
            panel.follows = kind
            try:
                panel.follow(int(u), int(v))
            except ValueError:  # nothing is there
                continue
            stories.setdefault(panel.name, panel.story)
            clicks.setdefault(kind, []).append([int(u), int(v), list(stories).index(panel.name)])
    each = max(MOST_PICTURES // len(stories), 8)
    pictures: dict[str, bytes] = {}
    told = []
    for number, (name, story) in enumerate(stories.items()):
        kept = some(list(range(len(story.moments))), each if number else MOST_MOMENTS)
        moments = []
        for k in kept:
            panel.show_story(story, name, k)
            file = f"{number}_{k}.webp"
            pictures[file] = webp(panel.picture(), 70)
            moments.append([
                story.moments[k].serial, file, panel.clicks.alt, panel.numbers.value, k + 1, list(panel.clicks.size),
            ])  # fmt: skip
        start = 0 if number else min(range(len(kept)), key=lambda i: abs(kept[i] - at))
        told.append({"name": name, "moments": moments, "count": len(story.moments), "start": start})
    panel.follows = follows
    panel.show_story(first, told[0]["name"], at)
    words = (
        f"Recorded: {len(told)} pixels, Gaussians and voxels, each through everything that happened to it. A click "
        "follows what is recorded next to it, as it was in the first picture; the notebook follows any pixel."
    )
    data = {"label": "A trace: what happened, in order", "stories": told, "follows": clicks}
    return Recorded(kind="trace", data=data, words=words, pictures=pictures)
