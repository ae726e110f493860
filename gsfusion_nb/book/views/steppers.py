"""Views that are a sequence: steppers, and live runs that went to their end."""

import base64
from typing import Any

import cv2
import numpy as np

from ...viz.live.live_loop import LiveLoop
from ...viz.live.live_mapper import LiveMapper
from ...viz.steppers.stepper import Stepper
from .panels import record_grids
from .recorded import Recorded, webp
from .some import some

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
