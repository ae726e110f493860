"""Frames that cannot be mapped are refused with a reason."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data import BadFrameError
from gsfusion_nb.mapping.step import BLACK, check_frame
from gsfusion_nb.types import Camera, Frame

GOOD = Frame(
    index=7,
    timestamp_s=0.0,
    rgb=torch.full((3, 4, 3), 0.5),
    depth_m=torch.ones(3, 4),
    camera=Camera(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5),
    T_WC=torch.eye(4),
)


def shifted(metres: float) -> torch.Tensor:
    T = torch.eye(4)
    T[1, 3] = metres
    return T


def test_a_good_frame_comes_back():
    assert check_frame(GOOD, needs_depth=True) is GOOD
    blind = dataclasses.replace(GOOD, depth_m=torch.zeros(3, 4))
    assert check_frame(blind) is blind
    dim = dataclasses.replace(GOOD, rgb=torch.full((3, 4, 3), 1.5 * BLACK))
    assert check_frame(dim) is dim


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_WC": torch.diag(torch.tensor([-1.0, 1, 1, 1]))}, "T_WC of frame 7 must be rigid: .* mirrors the world"),
        ({"T_WC": torch.full((4, 4), torch.nan)}, "T_WC of frame 7 must be finite"),
        ({"T_WC": shifted(1e6)}, r"T_WC of frame 7 must be within 10 km of the origin, got \(0, 1e\+06, 0\) m"),
        ({"T_WC": shifted(1e30)}, "T_WC of frame 7 must be within 10 km of the origin"),
        ({"camera": dataclasses.replace(GOOD.camera, fx=1e12)}, "its camera: fx must be between 0.2 and 400 pixels"),
        ({"camera": dataclasses.replace(GOOD.camera, cx=-500.0)}, "its camera: cx must be between -4 and 8 pixels"),
        ({"depth_m": torch.full((3, 4), torch.inf)}, "depth_m of frame 7 must be finite"),
        ({"rgb": torch.full((3, 4, 3), torch.nan)}, "rgb of frame 7 must be finite"),
        ({"rgb": torch.full((3, 4, 3), 128.0)}, r"rgb of frame 7 must be in 0\.\.1, got 128"),
        ({"rgb": torch.zeros(3, 4, 3)}, "its picture is black"),
        ({"depth_m": torch.zeros(3, 4)}, "it has no depth at all"),
    ],
)
def test_a_bad_frame_is_refused(change, message):
    with pytest.raises(BadFrameError, match=f"frame 7 cannot be mapped: .*{message}"):
        check_frame(dataclasses.replace(GOOD, **change), needs_depth=True)
