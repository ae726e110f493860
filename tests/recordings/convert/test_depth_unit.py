"""The unit of stored depth: what people film, and what the camera's motion tells."""

from functools import cache

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.readers.folder import folder as read_folder
from gsfusion_nb.recordings.convert.depth_camera import told_unit
from gsfusion_nb.recordings.convert.depth_motion import PosedDepth, units_per_metre
from gsfusion_nb.recordings.convert.depth_unit import find_depth_unit


def depths(near_m, far_m, scale):
    """A depth image from ``near_m`` to ``far_m`` as stored."""
    values = np.linspace(near_m, far_m, 4096) * scale
    return [np.rint(values).astype(np.uint16).astype(np.float32).reshape(64, 64)]


@pytest.fixture
def folder(tmp_path):
    """``folder(name)`` makes a folder."""

    def make(name):
        (tmp_path / name).mkdir()
        return tmp_path / name

    return make


def test_the_range_decides_where_only_one_unit_gives_plausible_depths(folder):
    unit = find_depth_unit(folder("scan"), depths(0.6, 2.0, 1000))
    assert (unit.scale, unit.is_guess, unit.question) == (1000, True, None)
    assert find_depth_unit(folder("other"), depths(1.0, 4.0, 5000)).scale == 5000


def test_a_guess_names_its_rivals_and_the_option(folder):
    """0.6 to 2 m in tenths of a millimetre look like 1.2 to 4 m in the benchmark's unit."""
    told = find_depth_unit(folder("scan"), depths(0.6, 2.0, 10_000)).sentence
    assert "nothing proves it" in told
    assert "10000 would be 1.30 m" in told
    assert "--depth-scale" in told


def test_what_nothing_decides_is_asked_for(folder):
    unclear = depths(2.0, 4.5, 1000)  # or 0.4 to 0.9 m with 5000
    assert "give --depth-scale" in str(find_depth_unit(folder("scan"), unclear).question)
    known = find_depth_unit(folder("rgbd_dataset_freiburg1_x"), unclear)
    assert (known.scale, known.is_guess) == (5000, False)


def test_whole_metres_have_lost_their_precision(folder):
    with pytest.raises(
        SequenceError, match=r"whole metres up to 4, so precision was lost .* export depth again"
    ):
        find_depth_unit(folder("scan"), depths(0.6, 4.0, 1))


def test_no_plausible_unit_is_asked_for(folder):
    assert "give --depth-scale" in str(
        find_depth_unit(folder("scan"), depths(0.02, 0.1, 1000)).question
    )
    with pytest.raises(SequenceError, match="hold no depth"):
        find_depth_unit(folder("empty"), [np.zeros((4, 4), np.float32)])


@cache
def pairs_of(root):
    """Frames of a Kinect, and others 4 and 12 frames later."""
    kitchen = read_folder(root)
    return [(kitchen[a], kitchen[a + gap]) for a in (0, 10, 20, 30) for gap in (4, 12)]


@pytest.fixture
def walk(shared_sequence):
    return pairs_of(shared_sequence("redkitchen_mini48"))


@pytest.mark.parametrize("scale", [10_000.0, 6553.5, 2000.0, 1.0])
def test_the_motion_of_a_kinect_tells_the_unit(walk, scale):
    def posed(frame):
        return PosedDepth(frame.depth_m * scale, frame.camera, frame.T_WC.double())

    assert units_per_metre([(posed(a), posed(b)) for a, b in walk]) == pytest.approx(
        scale, rel=0.05
    )


@pytest.mark.parametrize("wrong", ["inverted", "opengl"])
def test_wrong_poses_tell_no_unit(walk, wrong):
    """They must not move a right unit: the check names them."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

    def posed(frame):
        T = frame.T_WC.double()
        return PosedDepth(
            1000 * frame.depth_m,
            frame.camera,
            torch.linalg.inv(T) if wrong == "inverted" else T @ flip,
        )

    assert units_per_metre([(posed(a), posed(b)) for a, b in walk]) is None


def test_a_camera_that_stands_tells_no_unit(walk):
    still = torch.eye(4, dtype=torch.float64)
    pairs = [
        (PosedDepth(a.depth_m, a.camera, still), PosedDepth(a.depth_m, a.camera, still))
        for a, _ in walk
    ]
    assert units_per_metre(pairs) is None
    assert units_per_metre([]) is None


@pytest.mark.parametrize(
    ("tree", "scale"),
    [
        ({"m_depthShift": 1000.0}, 1000),  # BundleFusion, ScanNet
        ({"Camera": {"fx": 525.0}, "DepthMapFactor": 5000.0}, 5000),  # ORB-SLAM2
        ({"RGBD": {"DepthMapFactor": 1000.0}}, 1000),  # ORB-SLAM3
        ({"camera": {"scale": 6553.5}}, 6553.5),  # Replica of NICE-SLAM
        ({"depth_scale": 0.001}, 1000),  # RealSense: metres per unit
        ({"depth_scale": 0.1}, 10_000),  # BOP: millimetres per unit
        ({"depth_scale": 5000}, 5000),
    ],
)
def test_a_calibration_tells_the_unit_in_its_own_way(tree, scale):
    unit, notes = told_unit(tree, "camera.yaml", depths(0.6, 3.0, scale))
    assert unit is not None
    assert unit.scale == pytest.approx(scale)
    assert (unit.is_guess, notes) == (False, [])
    assert "of camera.yaml says" in unit.sentence


def test_a_unit_that_cannot_be_is_named_and_not_used():
    """ORB-SLAM's nodes for ROS have a factor of 1, since their depth comes in metres."""
    unit, notes = told_unit({"DepthMapFactor": 1.0}, "camera.yaml", depths(0.6, 3.0, 1000))
    assert unit is None
    assert (
        "DepthMapFactor of camera.yaml would make the median depth 1.8e+03 m, so it is not used"
        in notes[0]
    )
    assert told_unit(
        {"scale": 1.0, "fps": 30.0},
        "camera.yaml",
        depths(0.6, 3.0, 1000),
    ) == (
        None,
        [],
    )
    with pytest.raises(
        SequenceError, match="several units of depth, m_depthShift 1000, DepthMapFactor 5000"
    ):
        told_unit(
            {"m_depthShift": 1000.0, "DepthMapFactor": 5000.0}, "info.txt", depths(0.6, 3.0, 1000)
        )
