"""Recordings of RealSense Viewer and rs-record: topics, calibration and unit where the SDK writes
them."""

import struct

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, convert
from gsfusion_nb.recordings.convert.recording import OptionNeeded
from gsfusion_nb.types import Camera

pytest.importorskip("rosbags")
from ros_bags import Bag

DEPTH = "/device_0/sensor_0/Depth_0"
COLOUR = "/device_0/sensor_1/Color_0"
WIDE = Camera(
    width=90,
    height=68,
    fx=52.0,
    fy=50.0,
    cx=45.6,
    cy=33.4,
)
"""The depth camera sees more than colour, at a lower resolution."""
T_COLOUR_DEPTH = se3.exp(
    torch.tensor([0.015, 0.0002, 0.0004, 0.003, 0.004, 0.012], dtype=torch.float64)
)
"""As a D435i says it in Color_0/tf/0: x = 0.015014, the transform of points of depth to colour."""


def write(
    path,
    box,
    *,
    units=0.001,
    said="option",
    tf=True,
    depth_info=True,
    version="0",
    model="Brown Conrady",
    D=(),
):
    """Four frames of the box, as the SDK records them."""
    numbers = tuple(D) or (0.0,) * 5
    with Bag(path, 1) as bag:
        value = bag.store.types["std_msgs/msg/Float32"]
        if said == "option":
            bag.put("/device_0/sensor_0/option/Depth Units/value", value(data=units), 1.0)
        elif said == "newer":
            bag.put("/device_0/sensor_0/option/Depth_Units/value", value(data=units), 1.0)
        elif said == "property":
            pair = bag.store.types["diagnostic_msgs/msg/KeyValue"]
            bag.put("/device_0/sensor_0/property", pair(key="Depth Units", value=f"{units:f}"), 1.0)
        bag.info(f"{COLOUR}/info/camera_info", 1.0, "", box.camera, numbers, model=model)
        if depth_info:
            bag.info(f"{DEPTH}/info/camera_info", 1.0, "", WIDE, (0.0,) * 5, model="Brown Conrady")
        if tf:
            bag.put(f"{DEPTH}/tf/0", bag.transform(torch.eye(4).double()), 1.0)
            bag.put(f"{COLOUR}/tf/0", bag.transform(T_COLOUR_DEPTH), 1.0)
        for i, T in enumerate(box.poses(4)):
            t = 1.0 + 0.1 * i
            depth_m = box.render(T @ T_COLOUR_DEPTH, WIDE)[1]
            raw = np.rint(depth_m / units).astype(np.uint16)
            tail = struct.pack("<f", units) if version == "1" else b""
            bag.image(f"{DEPTH}/image/data", t, version, "mono16", raw, tail=tail)
            bag.image(
                f"{COLOUR}/image/data",
                t + 0.001,
                version,
                "rgb8",
                box.render(T)[0],
                tail=tail and b"\0" * 4,
            )
            bag.image(
                "/device_0/sensor_0/Infrared_1/image/data", t, "0", "mono8", raw.astype(np.uint8)
            )
            bag.image(
                "/device_0/sensor_0/Confidence_0/image/data", t, "0", "mono8", raw.astype(np.uint8)
            )
    return path


def check(out, box):
    """Camera, unit and registration are right."""
    frames = folder(out, poses=False)
    assert vars(frames.camera) == pytest.approx(vars(box.camera), abs=1e-4)
    for frame, T in zip(frames, box.poses(4), strict=True):
        truth = torch.from_numpy(box.render(T)[1])
        assert float((frame.depth_m > 0).float().mean()) > 0.97
        off = (frame.depth_m / truth - 1)[frame.depth_m > 0]
        assert abs(float(off.mean())) < 0.002  # with the inverse of T_COLOUR_DEPTH -0.008
        assert float(off.abs().median()) < 0.006


@pytest.mark.parametrize(
    ("units", "said", "version"),
    [
        (0.001, "option", "0"),
        (0.00025, "option", "0"),
        (0.0001, "newer", "0"),
        (0.00025, "property", "0"),
        (0.00025, "image", "1"),
        (0.001, "option", "1"),
    ],
)
def test_depth_is_registered_and_in_its_unit(tmp_path, box, units, said, version):
    path = write(tmp_path / "rs.bag", box, units=units, said=said, version=version)
    report = convert(path, tmp_path / "out", options=ConvertOptions(poses="none"))
    check(tmp_path / "out", box)
    assert report.depth_scale == pytest.approx(1 / units)
    assert f"depth read as {1 / units:g} per metre, as Depth Units say" in report.notes
    assert f"depth ({DEPTH}) was registered to colour ({COLOUR}), as tf says" in report.notes


def test_frames_named_0_prove_nothing(tmp_path, box):
    """Without the place of the cameras, or depth's camera, the bag is refused: no frame of it is
    aligned."""
    none = ConvertOptions(poses="none")
    with pytest.raises(OptionNeeded, match=r"tf of the streams is missing; give --T-colour-depth"):
        convert(write(tmp_path / "a.bag", box, tf=False), tmp_path / "out", options=none)
    with pytest.raises(OptionNeeded, match=r"has no camera_info; give --depth-intrinsics"):
        convert(write(tmp_path / "b.bag", box, depth_info=False), tmp_path / "out", options=none)
    file = tmp_path / "T.txt"
    file.write_text(" ".join(map(str, T_COLOUR_DEPTH.flatten().tolist())))
    given = ConvertOptions(poses="none", T_colour_depth=str(file))
    convert(tmp_path / "a.bag", tmp_path / "out", options=given)
    check(tmp_path / "out", box)


def test_a_recording_without_a_unit_says_what_was_taken(tmp_path, box):
    path = write(tmp_path / "rs.bag", box, said="nowhere")
    report = convert(path, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert any("has no Depth Units (--depth-scale)" in note for note in report.notes)


def test_units_that_change_are_refused(tmp_path, box):
    path = write(tmp_path / "rs.bag", box, units=0.001, version="1")
    with Bag(tmp_path / "two.bag", 1) as bag:
        value = bag.store.types["std_msgs/msg/Float32"]
        for units in (0.001, 0.00025):
            bag.put("/device_0/sensor_0/option/Depth Units/value", value(data=units), 1.0)
        bag.image(
            f"{DEPTH}/image/data",
            1.0,
            "0",
            "mono16",
            np.ones((4, 4), np.uint16),
        )
        bag.image(
            f"{COLOUR}/image/data",
            1.0,
            "0",
            "rgb8",
            np.ones((4, 4, 3), np.uint8),
        )
    given = ConvertOptions(poses="none", intrinsics="4", depth_intrinsics="colour")
    with pytest.raises(
        SequenceError, match=r"Depth Units of .* are 0\.001, 0\.00025; expected one length"
    ):
        convert(tmp_path / "two.bag", tmp_path / "out", options=given)
    assert path.is_file()


@pytest.mark.parametrize("model", ["Inverse Brown Conrady", "Modified Brown Conrady"])
def test_a_lens_that_is_read_in_either_direction_is_asked_for(tmp_path, box, model):
    path = write(
        tmp_path / "rs.bag",
        box,
        model=model,
        D=(-0.05, 0.06, -0.0006, 0.0004, -0.02),
    )
    none = ConvertOptions(poses="none")
    with pytest.raises(OptionNeeded, match=r"in either direction; give --intrinsics") as asked:
        convert(path, tmp_path / "out", options=none)
    assert asked.value.option == "intrinsics"
    c = box.camera
    given = ConvertOptions(poses="none", intrinsics=f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}")
    convert(path, tmp_path / "out", options=given)
    check(tmp_path / "out", box)
    convert(write(tmp_path / "zero.bag", box, model=model), tmp_path / "zero", options=none)
    check(tmp_path / "zero", box)
