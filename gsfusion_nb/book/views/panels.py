"""A panel with sliders, recorded: its picture at every point of a grid over one or two controls.

A panel with more controls is recorded over several grids; where a control of one grid moves, those of the others go
back to where the chapter has them.
"""

import base64
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from ...viz.live.live_loop import LiveLoop
from ...viz.live.live_mapper import LiveMapper
from ...viz.panels.panel import Panel
from ...viz.steppers.stepper import Stepper
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
