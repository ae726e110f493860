"""Cases of the notebook panels: time from moving a control, or dragging the picture, to the new picture.

What the browser adds, about 30 ms, is measured by ``tests/browser/test_touch.py``.
"""

import functools
from collections.abc import Callable, Iterator

import torch

from ...config import TsdfConfig, gsfusion
from ...data import Sequence, open_sequence
from ...mapping import GSFusion
from ...tsdf import TsdfVolume
from ...types import Camera, Frame
from ...viz import (
    GradientMicroscope,
    OrbitView,
    PixelMicroscope,
    amdahl_panel,
    frame_surface,
    icp_panel,
    orbit_view,
    point_panel,
    quadtree_panel,
    tsdf_fill_panel,
)
from ...viz.live.step_panels import live_panels
from ...viz.microscopes.one_gaussian import one_gaussian_panel, sh_ball_panel
from ...viz.panels.discs import disc_panel
from ...viz.panels.points import POINT_COLOURS
from ...viz.panels.quadtree import SHOWS as QUADTREE_SHOWS
from ...viz.panels.seeding_rule import SHOWS as RULE_SHOWS
from ...viz.panels.seeding_rule import rule_context, rule_panel
from .options import BenchOptions
from .rows import Case, Row
from .scene import random_scene
from .timing import lap, summary

MOVES = 11
"""Number of timed moves of a control; 3 with --quick."""
CAMERA = Camera(width=320, height=240, fx=208.0, fy=208.0, cx=160.0, cy=120.0)
MICROSCOPE_GAUSSIANS, GRADIENT_GAUSSIANS, ORBIT_GAUSSIANS = 5_000, 800, 20_000

Move = Callable[[int], object]
"""Function that sets a control to its i-th position and draws the picture."""


def cases(options: BenchOptions) -> Iterator[Case]:
    """One per panel."""
    moves = 3 if options.quick else MOVES
    for title, make in PANELS.items():
        yield Case(section="panels", title=title, run=functools.partial(_rows, title, make, moves))


def _rows(title: str, make: Callable[[], dict[str, Move]], moves: int) -> Iterator[Row]:
    for method, move in make().items():
        move(0)
        laps = [lap(functools.partial(move, i)) for i in range(1, moves + 1)]
        yield Row(section="panels", case=title, method=method, timing=summary(laps))


@functools.lru_cache(1)
def _room() -> Sequence:
    """A few frames of the built-in room, 640x480."""
    return open_sequence("room", n_frames=60).mapping


def _quadtree() -> dict[str, Move]:
    panels = {show: quadtree_panel(_room()[0].rgb).set(show=show) for show in QUADTREE_SHOWS}
    return {show: lambda i, p=panel: p.set(threshold=0.5 * 0.7**i) for show, panel in panels.items()}


def _points() -> dict[str, Move]:
    panels = {show: point_panel(_room()[0]).set(show=show) for show in POINT_COLOURS}
    moves = {show: lambda i, p=panel: p.set(turn_deg=4.0 * i - 20) for show, panel in panels.items()}
    touched = panels[POINT_COLOURS[0]]
    return {**moves, "click a pixel": lambda i: touched.drag((20.0 + 20 * i, 60.0 + 10 * i))}


def _filling() -> dict[str, Move]:
    """A volume with six views of a wall around the camera."""

    def wall(T_WC: torch.Tensor) -> Frame:
        camera = CAMERA.resized(160, 120)
        size = (camera.height, camera.width)
        rgb, depth_m = torch.full((*size, 3), 0.5), torch.full(size, 1.5)
        return Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera, T_WC=T_WC)

    panel = tsdf_fill_panel(TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0)), CAMERA, wall)
    for heading in range(-180, 180, 60):
        panel.set(heading_deg=float(heading)).press("measure")
    return {
        "heading": lambda i: panel.set(heading_deg=10.0 * i - 100),
        "height of the slice": lambda i: panel.set(height_m=1.0 + 0.05 * i),
        "drag the view": lambda i: panel.drag((500.0, 100.0), (500.0 + 12 * (i % 2 + 1), 100.0)),
    }


def _rule() -> dict[str, Move]:
    context = rule_context(_mapper(), _room()[4])
    panels = {show: rule_panel("gsfusion", context).set(show=show) for show in RULE_SHOWS}
    return {show: lambda i, p=panel: p.set(required_weight=1.0 + i % 2) for show, panel in panels.items()}


def _live() -> dict[str, Move]:
    mapper = _mapper()
    return {"all panels": lambda i: live_panels(mapper, _room()[i % 2]).mosaic()}


def _mapper() -> GSFusion:
    """A mapper after two frames of the room."""
    mapper = GSFusion(gsfusion("room"))
    for i in range(2):
        mapper.step(_room()[i])
    return mapper


def _orbit() -> dict[str, Move]:
    scene = random_scene(ORBIT_GAUSSIANS, CAMERA.width, CAMERA.height, sh_degree=3)
    view = orbit_view(scene.params, size=(CAMERA.width, CAMERA.height))

    def drag(i: int) -> OrbitView:
        view.image.stroke = [1.0, 0.0, 100.0, 100.0, 100.0 + 10 * (i + 1), 100.0]
        return view

    return {"azimuth": lambda i: view.set(azimuth_deg=12.0 * i - 100), "drag the map": drag}


def _pixel_microscope() -> dict[str, Move]:
    scene = random_scene(MICROSCOPE_GAUSSIANS, CAMERA.width, CAMERA.height)
    microscope = PixelMicroscope(scene.params, scene.camera, scene.T_WC)
    return {"click": lambda i: microscope.look_at(20 + 25 * i, 20 + 18 * i)}


def _gradient_microscope() -> dict[str, Move]:
    scene = random_scene(GRADIENT_GAUSSIANS, 160, 120)
    target = torch.rand(120, 160, 3, generator=torch.Generator().manual_seed(0))
    moves: dict[str, Move] = {}
    for pick in ("pixel", "Gaussian"):
        microscope = GradientMicroscope(scene.params, scene.camera, scene.T_WC, target)
        microscope.pick = pick
        moves[f"click, {pick}"] = lambda i, m=microscope: m.look_at(10 + 12 * i, 10 + 9 * i)
    return moves


def _disc_scene() -> dict[str, Move]:
    panel = disc_panel()
    return {"lean": lambda i: panel.set(lean_deg=5 * i)}


def _one_gaussian() -> dict[str, Move]:
    panel = one_gaussian_panel(Camera(width=80, height=60, fx=52.0, fy=52.0, cx=40.0, cy=30.0))
    return {
        "turn": lambda i: panel.set(turn_deg=5 * i),
        "drag the middle": lambda i: panel.set(x_m=0.0).drag((240.0, 180.0), (250.0 + 5 * i, 180.0)),
    }


def _sh_ball() -> dict[str, Move]:
    panel = sh_ball_panel()
    return {"red": lambda i: panel.set(red=0.1 * i)}


def _icp() -> dict[str, Move]:
    """Another step of a known alignment, and an alignment from another start."""
    frame = _room()[2]
    panel = icp_panel(frame, frame_surface(_room()[0]))
    return {
        "step": lambda i: panel.set(step=1 + i),
        "another start": lambda i: panel.set(sideways_cm=2 * i),
    }


def _amdahl() -> dict[str, Move]:
    panel = amdahl_panel({"seed": 0.1, "optimise": 0.3})
    return {"optimise": lambda i: panel.set(optimise=1.0 + 0.5 * i)}


PANELS: dict[str, Callable[[], dict[str, Move]]] = {
    "quadtree 640x480": _quadtree,
    "points of a frame 640x480": _points,
    "filling a volume 320x240": _filling,
    "seeding rule 640x480": _rule,
    "live mapping 640x480": _live,
    "orbit, 20k SH3 320x240": _orbit,
    "pixel, 5k 320x240": _pixel_microscope,
    "gradients, 800 160x120": _gradient_microscope,
    "disc depth": _disc_scene,
    "one Gaussian": _one_gaussian,
    "colour ball": _sh_ball,
    "ICP 640x480": _icp,
    "Amdahl": _amdahl,
}
"""Name in the table -> function that makes the panel and returns the moves, one per row."""
