import dataclasses

import pytest
import torch

from gsfusion_nb.checks import check_finite, check_pose
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=8,
    height=6,
    fx=7.0,
    fy=7.5,
    cx=4.0,
    cy=3.0,
)


def test_resizing_a_camera_keeps_the_field_of_view_and_the_edges():
    half = CAMERA.resized(4, 3)
    assert (half.fx, half.fy, half.cx, half.cy) == (3.5, 3.75, 2.0, 1.5)
    assert half.resized(8, 6) == CAMERA


def test_frame_checks_sizes():
    with pytest.raises(ValueError, match=r"rgb must be \[6, 8, 3\], got \[6, 7, 3\]"):
        Frame(
            index=0,
            timestamp_s=0.0,
            rgb=torch.zeros(6, 7, 3),
            depth_m=torch.zeros(6, 7),
            camera=CAMERA,
            T_WC=torch.eye(4),
        )


def frame_of(rgb: torch.Tensor) -> Frame:
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.ones(6, 8),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def test_bytes_stay_bytes_until_somebody_asks_for_floats():
    levels = torch.randint(0, 256, (6, 8, 3), dtype=torch.uint8)
    frame = frame_of(levels)
    assert frame.is_8_bit
    assert frame.rgb_u8 is levels
    assert torch.equal(frame.rgb, levels.float() / 255)
    assert frame.rgb is frame.rgb
    assert frame.to("cpu") is frame
    moved = dataclasses.replace(frame, T_WC=2 * torch.eye(4))
    assert moved.rgb_u8 is levels
    assert float(dataclasses.replace(frame, rgb=torch.zeros(6, 8, 3)).rgb.max()) == 0
    with pytest.raises(
        ValueError, match=r"rgb of frame 0 must be a float32 or uint8 torch.Tensor, got torch.int64"
    ):
        frame_of(levels.long())


def test_eight_bit_colours_survive_the_way_through_floats():
    every = torch.arange(288).remainder(256).to(torch.uint8).reshape(2, 6, 8, 3)
    for levels in every:
        frame = frame_of(levels.float() / 255)
        assert not frame.is_8_bit
        assert frame.rgb is frame.colour
        assert torch.equal(frame.rgb_u8, levels)


def test_check_pose_names_the_fault():
    check_pose("T", torch.eye(4))
    with_nan = torch.eye(4)
    with_nan[0, 3] = torch.nan
    with pytest.raises(
        ValueError, match=r"must be finite, got 1 NaN or infinite values, the first at \[0, 3\]"
    ):
        check_pose("T", with_nan)
    with pytest.raises(ValueError, match="must be rigid: its rotation misses"):
        check_pose("T", torch.diag(torch.tensor([2.0, 1, 1, 1])))
    with pytest.raises(ValueError, match="mirrors the world"):
        check_pose(
            "T",
            torch.diag(torch.tensor([-1.0, 1, 1, 1])),
        )
    with pytest.raises(ValueError, match=r"must end in the row \[0, 0, 0, 1\]"):
        check_pose("T", torch.diag(torch.tensor([1.0, 1, 1, 2])))
    with pytest.raises(ValueError, match=r"T must be \[4, 4\], got \[3, 4\]"):
        check_pose("T", torch.eye(4)[:3])


def test_check_finite_counts():
    with pytest.raises(ValueError, match=r"got 2 NaN or infinite values, the first at \[1\]"):
        check_finite("x", torch.tensor([0.0, torch.inf, torch.nan]))
