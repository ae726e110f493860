"""Repairing a recording by hand: sliders for the usual mistakes, and what two of its frames say about them."""

import numpy as np

from ...checks import check_whole
from ...config import RepairConfig
from ...data.adjust.depth_agreement import depth_agreement
from ...data.adjust.repair import repaired
from ...data.sequence import Sequence
from ...drawing.pictures import side_by_side
from ...recordings.checkup.pictures import depth_error, edge_overlay
from ..microscopes.stack_picture import resize_to_height
from .panel import Drawn, Number, Panel, Slider

_HEIGHT_PX = 270


def repair_panel(sequence: Sequence, first: int, second: int) -> Panel:
    """Sliders for depth scale, time of the poses, focal length and position of the colour image.

    Left: the depth of frame ``first``, moved into frame ``second`` with the poses, minus the depth there (dark: equal,
    light yellow: 10 cm and more). Right: frame ``second`` with the depth image's edges in green.

    Args:
        sequence: The recording as it is read.
        first, second: Two frames that see the same things from different places.

    Raises:
        IndexError: no such frame.
    """
    for name, at in (("first", first), ("second", second)):
        check_whole(name, at, 0)
        if at >= len(sequence):
            raise IndexError(f"{name} must be below {len(sequence)}, got {at}")
    camera = sequence.camera

    def draw(*, depth_factor: Number, pose_shift: Number, focal: Number, right_px: Number, down_px: Number) -> Drawn:
        repair = RepairConfig(
            depth_factor=float(depth_factor),
            pose_shift_frames=float(pose_shift),
            fx=float(focal * camera.fx),
            fy=float(focal * camera.fy),
            rgb_shift_x_px=float(right_px),
            rgb_shift_y_px=float(down_px),
        )
        mended = repaired(sequence, repair)
        a, b = mended[first], mended[second]
        found = depth_agreement(a, b, step=2)
        parts = [resize_to_height(np.asarray(p), _HEIGHT_PX) for p in (depth_error(a, b), edge_overlay(b))]
        labels = [f"frame {first} in frame {second}: error of depth", f"frame {second}: edges of depth on colour"]
        words = f"<b>{found.agreeing:.0%}</b> of the points agree within 3 %; median difference "
        return side_by_side(parts, labels), f"{words}{100 * found.median_m:.1f} cm"

    controls = {
        "depth_factor": Slider(value=1.0, low=0.1, high=10.0, step=0.005, label="depth ×", log=True),
        "pose_shift": Slider(value=0.0, low=-3, high=3, step=0.1, label="poses later, frames", readout=".1f"),
        "focal": Slider(value=1.0, low=0.8, high=1.2, step=0.01, label="focal length ×"),
        "right_px": Slider(value=0.0, low=-10, high=10, step=0.5, label="colour right, px", readout=".1f"),
        "down_px": Slider(value=0.0, low=-10, high=10, step=0.5, label="colour down, px", readout=".1f"),
    }
    return Panel(draw, controls, name="repair", text="A recording, repaired by hand")
