import dataclasses

import numpy as np
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


def frame_of_arrays(**changes) -> Frame:
    given = {
        "rgb": np.full((6, 8, 3), 51, dtype=np.uint8),
        "depth_m": np.full((6, 8), 1.5),
        "T_WC": np.eye(4),
    }
    return Frame(index=7, timestamp_s=0.0, camera=CAMERA, **(given | changes))


def test_a_frame_of_arrays_is_that_of_tensors_and_says_what_was_converted():
    frame = frame_of_arrays()
    assert frame.is_8_bit
    assert float(frame.rgb.max()) == pytest.approx(0.2)
    assert torch.equal(frame.depth_m, torch.full((6, 8), 1.5))
    assert torch.equal(frame.T_WC, torch.eye(4))
    assert frame.conversions == (
        "rgb: numpy.ndarray of uint8 copied to a torch.Tensor of uint8",
        "depth_m: numpy.ndarray of float64 copied to a torch.Tensor of float32",
        "T_WC: numpy.ndarray of float64 copied to a torch.Tensor of float32",
    )
    assert not dataclasses.replace(frame).conversions
    in_floats = frame_of_arrays(rgb=np.full((6, 8, 3), 0.2, dtype=">f8"), T_WC=np.eye(4, dtype=int))
    assert not in_floats.is_8_bit
    assert float(in_floats.rgb.max()) == pytest.approx(0.2)


def test_a_camera_may_fill_its_array_again():
    depth_m = np.ones((6, 8), dtype=np.float32)
    colours = np.zeros((6, 8, 3), dtype=np.uint8)
    frame = frame_of_arrays(rgb=colours[..., ::-1], depth_m=depth_m[::-1])
    depth_m[:] = 9
    colours[:] = 9
    assert float(frame.depth_m.max()) == 1
    assert int(frame.rgb_u8.max()) == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"depth_m": np.full((6, 8), 1500, dtype=np.uint16)},
            r"depth_m of frame 7 must be float, in metres, .* uint16, whose unit .* depth / 1000.0",
        ),
        (
            {"rgb": np.full((6, 8, 3), 51)},
            r"rgb of frame 7 must be uint8 \(0..255\) or float \(0..1\), .* int64, whose scale",
        ),
        (
            {"rgb": np.full((6, 8, 3), 51.0)},
            r"rgb of frame 7 of floats must be in 0..1, got values up to 51; .*astype\(np.uint8\)",
        ),
        ({"rgb": np.zeros((6, 8, 4), dtype=np.uint8)}, r"rgb must be \[6, 8, 3\], got \[6, 8, 4\]"),
        ({"T_WC": np.full((4, 4), "x")}, "T_WC of frame 7 must hold numbers"),
    ],
)
def test_an_array_whose_scale_is_not_known_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        frame_of_arrays(**changes)
