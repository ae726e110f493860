"""The tracer: a few pixels, Gaussians and voxels, each with everything that happened to it, in order."""

from collections.abc import Sequence
from typing import Any

from ...viz.panels.trace import FOLLOWS, TracePanel
from .panels import counts_of
from .recorded import Recorded, webp
from .some import some

PIXELS = (("u:3", "v:2"),)
"""Pixels that can be clicked, columns and rows."""
MOST_PICTURES = 360
"""Of all stories together; of a longer story, some moments are left out."""
MOST_MOMENTS = 60
"""Of the story that the chapter shows."""


def record_trace(panel: TracePanel, grids: Sequence[Sequence[str]] = ()) -> Recorded:
    """The story that a panel shows, and those of a few pixels of the picture: each pixel's own, its heaviest Gaussian's
    and that of the voxel at its surface."""
    across, down = counts_of(grids or PIXELS, ("u", "v"))
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
