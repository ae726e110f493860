"""Recorders of live views: panels, steppers and live runs as pictures; maps, meshes and microscopes as data."""

import base64
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import torch

from gsfusion_nb.drawing.pictures import encode_png, to_uint8
from gsfusion_nb.viz.live import LiveLoop, LiveMapper
from gsfusion_nb.viz.meshes import MeshViewer, decimated
from gsfusion_nb.viz.panels.gradient_microscope import PICTURE_PX, GradientMicroscope
from gsfusion_nb.viz.panels.panel import Panel
from gsfusion_nb.viz.panels.pixel_microscope import PICTURE_PX as SHOWN_PX
from gsfusion_nb.viz.panels.pixel_microscope import MixMicroscope, PixelMicroscope
from gsfusion_nb.viz.panels.pixel_stack import Splats
from gsfusion_nb.viz.panels.trace import FOLLOWS, TracePanel
from gsfusion_nb.viz.splat_rows import RowLayout, pack_rows
from gsfusion_nb.viz.splat_viewer import SplatViewer
from gsfusion_nb.viz.steppers.stepper import Stepper

from .recorded import Recorded, some, webp

MOST_PICTURES = 150
"""Of one grid."""


def record_panel(panel: Panel, grids: Sequence[Sequence[str]]) -> Recorded:
    """Record a panel.

    Args:
        panel: As the chapter shows it.
        grids: Names of the controls that move together; "threshold:12" takes 12 positions of a slider.

    Raises:
        ValueError: a grid has too many pictures.
        KeyError: a control does not exist.
    """
    wanted = {name: int(count or 9) for grid in grids for name, _, count in [g.partition(":") for g in grid]}
    start = dict(panel.values)
    positions = {name: _positions(panel.controls[name], count) for name, count in wanted.items()}
    controls = [
        {
            "name": name,
            "label": panel.controls[name].description,
            "words": [_read_out(panel.controls[name], value) for value in values],
            "start": values.index(start[name]),
            "kind": "slider" if hasattr(panel.controls[name], "step") else "choice",
        }
        for name, values in positions.items()
    ]

    def at(chosen: Mapping[str, int]) -> tuple[np.ndarray, str, str]:
        panel.set(**{**start, **{name: positions[name][k] for name, k in chosen.items()}})
        return panel.picture(), panel.caption.value, panel.image.alt

    names = [[g.partition(":")[0] for g in grid] for grid in grids]
    fixed = [panel.controls[n].description for n in panel.controls if n not in wanted]
    recorded = record_grids(at, controls, names, drawing=panel.kind == "png")
    panel.set(**start)
    recorded.data |= {"label": panel.text, "width": panel.picture().shape[1]}
    if fixed:
        recorded.words += f" Fixed in this recording: {', '.join(fixed)}."
    return recorded


def record_grids(
    at: Callable[[Mapping[str, int]], tuple[np.ndarray, str, str]],
    controls: Sequence[Mapping[str, Any]],
    grids: Sequence[Sequence[str]],
    *,
    drawing: bool = False,
) -> Recorded:
    """Pictures at every point of some grids.

    Args:
        at: Name of control -> number of its position, the others at their start -> picture, words in HTML, description.
        controls: Name, label, words of each position, number of the starting one, "slider" or "choice".
        grids: Names of the controls of each.
        drawing: Lines and writing, not photographs: finer pictures.
    """
    by_name = {control["name"]: control for control in controls}
    pictures: dict[str, bytes] = {}
    made = []
    for number, grid in enumerate(grids):
        counts = [len(by_name[name]["words"]) for name in grid]
        if (total := int(np.prod(counts))) > MOST_PICTURES:
            raise ValueError(
                f"a grid over {', '.join(grid)} has {total} pictures; at most {MOST_PICTURES} are recorded"
            )
        captions, alts = [], []
        for place in itertools.product(*map(range, counts)):
            picture, words, alt = at(dict(zip(grid, place, strict=True)))
            name = f"{number}_{'_'.join(map(str, place))}.webp"
            pictures[name] = webp(picture, 82 if drawing else 68)
            captions.append(words)
            alts.append(alt)
        made.append({"controls": list(grid), "counts": counts, "captions": captions, "alts": alts})
    words = "Recorded when the book was built: a slider stops at some positions; in the notebook it moves freely."
    if len(grids) > 1:
        words += " Controls in different boxes do not move together here."
    return Recorded(kind="panel", data={"controls": list(controls), "grids": made}, words=words, pictures=pictures)


def counts_of(grids: Sequence[Sequence[str]], names: Sequence[str]) -> list[int]:
    """Numbers of positions of some controls, given as "u:9"."""
    given = {name: int(count) for grid in grids for name, _, count in [one.partition(":") for one in grid]}
    if sorted(given) != sorted(names):
        raise ValueError(f"expected a grid over {', '.join(names)}, each with a number as in u:9, got {sorted(given)}")
    return [given[name] for name in names]


def _positions(control: Any, count: int) -> list[Any]:
    """Values of a control: all words of a choice, evenly spread ones of a slider, the present one among them."""
    if not hasattr(control, "step"):
        return list(control.options) if hasattr(control, "options") else [False, True]
    whole = isinstance(control.value, int)
    ends = (control.min, control.max)
    spread = np.linspace(*ends, min(count, int((ends[1] - ends[0]) / control.step) + 1))
    stepped = ends[0] + np.round((spread - ends[0]) / control.step) * control.step
    values = 10**stepped if hasattr(control, "base") else stepped
    found = [round(float(value)) if whole else round(float(value), 6) for value in values]
    nearest = min(range(len(found)), key=lambda k: abs(found[k] - control.value))
    found[nearest] = control.value
    return sorted(set(found))


def _read_out(control: Any, value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return format(value, getattr(control, "readout_format", ".3g"))
    return str(value)


MOST_FRAMES = 60
"""Of a live run; a longer one is recorded with gaps."""


def record_stepper(stepper: Stepper) -> Recorded:
    """Every step, shown by the stepper's own script."""
    steps = []
    for k in range(stepper.count):
        stepper.go_to(k)
        picture = base64.b64encode(webp(stepper.picture(), 60)).decode("ascii")
        steps.append([picture, stepper.alt, stepper.title, stepper.code, stepper.numbers])
    stepper.restart()
    data = {"steps": steps, "name": stepper.name, "label": stepper.label, "width": stepper.width}
    words = f"All {len(steps)} steps, recorded: press Next and Back, or the arrow keys."
    return Recorded(kind="stepper", data=data, words=words)


def record_live_mapper(live: LiveMapper) -> Recorded:
    """The pictures of every frame that was mapped; frames that are left are mapped first."""
    live.run_sync()
    entries = [entry for entry in live.scrubber.entries if entry[0]]
    entries = some(entries, MOST_FRAMES)
    captions = [image.alt for image in live.images.values()]

    def at(chosen: Any) -> tuple[np.ndarray, str, str]:
        k = chosen.get("frame", 0)
        mapped, pictures = entries[k]
        live._show_kept((mapped, pictures))
        picture = _mosaic([_decoded(picture) for picture in pictures.values()])
        return picture, live.status.value, f"after {mapped} frames, row by row: {'; '.join(captions)}"

    words = [str(mapped) for mapped, _ in entries]
    last = next((k for k, (mapped, _) in enumerate(entries) if mapped == live._shown), len(entries) - 1)
    control = {"name": "frame", "label": "frames mapped", "words": words, "start": last, "kind": "slider"}
    recorded = record_grids(at, [control], [["frame"]])
    recorded.data["label"] = f"A live run; row by row: {'; '.join(captions)}"
    recorded.words = "The whole run, recorded: the slider goes through its frames."
    return recorded


def record_live_loop(loop: LiveLoop) -> Recorded:
    """The picture of the steps that a loop kept; steps that are left are done first."""
    loop.run_sync()
    entries = some(loop.scrubber.entries, MOST_FRAMES)

    def at(chosen: Any) -> tuple[np.ndarray, str, str]:
        step, picture = entries[chosen["step"]]
        return _decoded(picture), f"step {step}", f"the picture of step {step}"

    words = [str(step) for step, _ in entries]
    control = {"name": "step", "label": "step", "words": words, "start": len(entries) - 1, "kind": "slider"}
    recorded = record_grids(at, [control], [["step"]])
    recorded.data["label"] = "A computation, step by step"
    recorded.words = "Recorded: the slider goes through the steps."
    return recorded


def _mosaic(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures of one size in rows of two."""
    height, width = pictures[0].shape[:2]
    same = [np.asarray(cv2.resize(picture, (width, height))) for picture in pictures]
    same += [np.full_like(same[0], 255)] * (len(same) % 2)
    return np.concatenate([np.concatenate(same[k : k + 2], 1) for k in range(0, len(same), 2)])


def _decoded(picture: bytes) -> np.ndarray:
    blue_first = np.asarray(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR))
    return np.ascontiguousarray(blue_first[..., ::-1])


PIXELS = (("u:9", "v:7"),)
"""Pixels of the gradient microscope that are recorded, columns and rows."""


def record_microscope(microscope: PixelMicroscope) -> Recorded:
    """Every pixel: the page gets the Gaussians on the screen and blends them itself."""
    camera = microscope.splats.camera
    values = splat_rows(microscope.splats)
    data = {
        "splats": base64.b64encode(values.tobytes()).decode("ascii"),
        "picture": base64.b64encode(encode_png(microscope.rendered, 9)).decode("ascii"),
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
    places = [_positions(microscope.controls[name], count) for name, count in (("u", across), ("v", down))]
    recorded = record_panel(microscope, [["pick", f"u:{across}", f"v:{down}"]])
    height, width = microscope.picture().shape[:2]
    first = round(camera.width * PICTURE_PX / camera.height)
    recorded.data["click"] = {
        "controls": ["u", "v"],
        "places": places,
        "area": [0, (height - PICTURE_PX) / height, first / width, 1],
        "size": [camera.width, camera.height],
    }
    recorded.words = (
        f"Recorded for {across} x {down} pixels: click the picture at the left, and the nearest of them is shown."
    )
    return recorded


TRACE_PIXELS = (("u:3", "v:2"),)
"""Pixels that can be clicked, columns and rows."""
MOST_TRACED = 360
"""Of all stories together; of a longer story, some moments are left out."""
MOST_MOMENTS = 60
"""Of the story that the chapter shows."""


def record_trace(panel: TracePanel, grids: Sequence[Sequence[str]] = ()) -> Recorded:
    """The story that a panel shows, and those of a few pixels of the picture: each pixel's own, its heaviest Gaussian's
    and that of the voxel at its surface."""
    across, down = counts_of(grids or TRACE_PIXELS, ("u", "v"))
    at, follows = panel.moment, panel.values["follows"]
    first, camera = panel.story, panel.story.moments[panel.moment].camera
    stories = {panel.name_of_story: first}
    clicks: dict[str, list[list[Any]]] = {}
    for kind in FOLLOWS:
        for k in range(across * down):
            u, v = (k % across + 0.5) * camera.width / across, (k // across + 0.5) * camera.height / down
            panel.show_story(first, next(iter(stories)), at)
            panel.set(follows=kind)
            try:
                panel.follow(int(u), int(v))
            except ValueError:  # nothing is there
                continue
            stories.setdefault(panel.name_of_story, panel.story)
            clicks.setdefault(kind, []).append([int(u), int(v), list(stories).index(panel.name_of_story)])
    each = max(MOST_TRACED // len(stories), 8)
    pictures: dict[str, bytes] = {}
    told = []
    for number, (name, story) in enumerate(stories.items()):
        kept = some(list(range(len(story.moments))), each if number else MOST_MOMENTS)
        moments = []
        for k in kept:
            panel.show_story(story, name, k)
            file = f"{number}_{k}.webp"
            pictures[file] = webp(panel.picture(), 70)
            size = [camera.width, camera.height]
            moments.append([story.moments[k].serial, file, panel.image.alt, panel.caption.value, k + 1, size])
        start = 0 if number else min(range(len(kept)), key=lambda i: abs(kept[i] - at))
        told.append({"name": name, "moments": moments, "count": len(story.moments), "start": start})
    panel.set(follows=follows)
    panel.show_story(first, told[0]["name"], at)
    words = (
        f"Recorded: {len(told)} pixels, Gaussians and voxels, each through everything that happened to it. A click "
        "follows what is recorded next to it, as it was in the first picture; the notebook follows any pixel."
    )
    data = {"label": "A trace: what happened, in order", "stories": told, "follows": clicks}
    return Recorded(kind="trace", data=data, words=words, pictures=pictures)


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


def record(view: Any, grids: Sequence[Sequence[str]] = ()) -> Recorded:
    """Record whatever a cell shows.

    Raises:
        TypeError: there is no recorder for it.
    """

    recorders: dict[type, Any] = {
        GradientMicroscope: record_gradients, TracePanel: record_trace, MixMicroscope: record_mix,
        PixelMicroscope: record_microscope, Panel: record_panel, Stepper: record_stepper,
        LiveMapper: record_live_mapper, LiveLoop: record_live_loop, SplatViewer: record_splats,
        MeshViewer: record_mesh,
    }  # fmt: skip
    with_grids = (GradientMicroscope, TracePanel, Panel)
    for kind, act in recorders.items():
        if isinstance(view, kind):
            return act(view, grids) if kind in with_grids else act(view)
    known = ", ".join(kind.__name__ for kind in recorders)
    raise TypeError(f"there is no recorder for {type(view).__name__}; known: {known}")
