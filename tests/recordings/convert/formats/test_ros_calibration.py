"""What a ROS bag says about its cameras and poses, and what it does not say."""

import shutil

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, RosOptions, convert
from gsfusion_nb.recordings.convert.recording import OptionNeeded
from gsfusion_nb.types import Camera

pytest.importorskip("rosbags")
from ros_bags import Bag
from rosbags.typesys import get_types_from_msg

FROM_BASE = se3.exp(torch.tensor([0.1, -0.05, 0.2, 1.2, -1.1, 1.25], dtype=torch.float64))
"""Optical frame to base."""
FRAME = "camera_optical"
MAP_FROM_ODOM = se3.exp(torch.tensor([5.0, -1.0, 0.3, 0.0, 0.0, 0.4], dtype=torch.float64))


def record(
    path,
    box,
    *,
    frames=(FRAME, FRAME),
    infos=("colour", "depth"),
    more=None,
    depth_camera=None,
    **of_depth,
):
    """Four frames of the box; ``more(bag, i, t, T)`` adds messages. ``of_depth`` goes into its
    camera_info."""
    camera = depth_camera or box.camera
    T_colour_depth = of_depth.get("T", torch.eye(4, dtype=torch.float64))
    said = of_depth.get("said", camera)
    roi = of_depth.get("roi", (0, 0, 0, 0))
    with Bag(path, 1) as bag:
        for i, T in enumerate(box.poses(4)):
            t = 1.0 + 0.1 * i
            if "colour" in infos:
                bag.info("/cam/color/camera_info", t, frames[0], box.camera)
            if "depth" in infos:
                bag.info("/cam/depth/camera_info", t, frames[1], said, roi=roi)
            rgb = box.render(T)[0]
            depth_m = box.render(T @ T_colour_depth, camera)[1]
            bag.image("/cam/color/image_raw", t, frames[0], "rgb8", rgb)
            bag.image(
                "/cam/depth/image_raw",
                t,
                frames[1],
                "16UC1",
                np.rint(1000 * depth_m).astype(np.uint16),
            )
            if more is not None:
                more(bag, i, t, T)
    return path


def tf_of_base(bag, i, t, T):
    """base_link in odom, and the camera in base_link."""
    bag.tf("/tf_static", t, "base_link", FRAME, FROM_BASE)
    bag.tf("/tf", t, "odom", "base_link", T @ se3.inverse(FROM_BASE))


def poses_of(out, box):
    return torch.stack([frame.T_WC.double() for frame in folder(out)]), box.poses(4)


@pytest.mark.parametrize("world", ["", "odom", "map"])
def test_two_parents_of_a_frame_are_two_transforms(tmp_path, box, world):
    """Odometry and localisation both publish base_link, each in a world of its own."""

    def both(bag, i, t, T):
        tf_of_base(bag, i, t, T)
        bag.tf(
            "/tf",
            t + 0.002,
            "map",
            "base_link",
            MAP_FROM_ODOM @ T @ se3.inverse(FROM_BASE),
        )
        bag.tf("/tf", t + 0.004, "odom", "base_link", T @ se3.inverse(FROM_BASE))

    path = record(tmp_path / "scan.bag", box, more=both)
    options = ConvertOptions(ros=RosOptions(world_frame=world))
    report = convert(path, tmp_path / "out", options=options)
    found, truth = poses_of(tmp_path / "out", box)
    if world == "map":  # 2 ms after its stamp, and not before the first
        assert report.frames == 3
        assert (found - MAP_FROM_ODOM @ truth[1:]).abs().max() < 5e-3
    else:
        assert (found - truth).abs().max() < 1e-6
    told = "it also leads to 'map' (--ros.world-frame)"
    assert any(told in note for note in report.notes) == (world == "")
    with pytest.raises(
        SequenceError,
        match="does not lead from the camera's frame 'camera_optical' to 'earth'; its",
    ):
        convert(path, tmp_path / "x", options=ConvertOptions(ros=RosOptions(world_frame="earth")))


def test_odometry_beside_a_tree_without_the_camera_is_named(tmp_path, box):
    def more(bag, i, t, T):
        bag.tf("/tf", t, "odom", "base_link", T @ se3.inverse(FROM_BASE))
        bag.odometry("/odom", t, "base_link", T @ se3.inverse(FROM_BASE))

    path = record(tmp_path / "scan.bag", box, more=more)
    words = (
        r"tf does not know the camera's frame 'camera_optical' .*base_link, odom.*/odom \(of "
        r"base_link\)"
    )
    with pytest.raises(OptionNeeded, match=words):
        convert(path, tmp_path / "out")
    file = tmp_path / "T.txt"
    file.write_text(" ".join(map(str, FROM_BASE.flatten().tolist())))
    given = ConvertOptions(T_body_cam=str(file), ros=RosOptions(pose_topic="/odom"))
    convert(path, tmp_path / "out", options=given)
    found, truth = poses_of(tmp_path / "out", box)
    assert (found - truth).abs().max() < 1e-6
    convert(path, tmp_path / "none", options=ConvertOptions(poses="none"))


def test_odometry_is_taken_where_the_tree_only_says_where_the_camera_is(tmp_path, box):
    """tf of a robot may turn its wheels and hold the camera, and leave the robot's pose to
    /odom."""

    def more(bag, i, t, T):
        bag.tf("/tf_static", t, "base_link", FRAME, FROM_BASE)
        bag.tf(
            "/tf",
            t,
            "base_link",
            "wheel",
            se3.exp(torch.tensor([0, 0, 0, 0.1 * i, 0, 0], dtype=torch.float64)),
        )
        bag.odometry("/odom", t, "base_link", T @ se3.inverse(FROM_BASE))

    report = convert(record(tmp_path / "scan.bag", box, more=more), tmp_path / "out")
    found, truth = poses_of(tmp_path / "out", box)
    assert (found - truth).abs().max() < 1e-6
    assert report.notes[0].endswith("poses /odom")


def test_odometry_of_a_body_whose_camera_is_unknown_is_no_camera_pose(tmp_path, box):
    path = record(
        tmp_path / "a.bag",
        box,
        more=lambda bag, i, t, T: bag.odometry("/odom", t, "base_link", T),
    )
    with pytest.raises(
        OptionNeeded, match=r"where the colour camera, .* is in the body of /odom \(of base_link\)"
    ):
        convert(path, tmp_path / "out")


def test_tf_of_older_bags_and_namespaces_and_of_one_time(tmp_path, box):
    """tf/tfMessage instead of tf2_msgs/TFMessage; rows of one time that differ are said."""

    def more(bag, i, t, T):
        bag.store.register(
            get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage")
        )
        bag.tf("/robot/tf", t, "odom", FRAME, T, kind="tf/msg/tfMessage")
        if i == 2:
            bag.tf("/robot/tf", t, "odom", FRAME, MAP_FROM_ODOM @ T, kind="tf/msg/tfMessage")

    report = convert(record(tmp_path / "scan.bag", box, more=more), tmp_path / "out")
    found, truth = poses_of(tmp_path / "out", box)
    assert (found - truth).abs().max() < 1e-6
    assert any(
        "1 transforms have the time of another one and differ" in note for note in report.notes
    )


NARROW = Camera(
    width=80,
    height=60,
    fx=96.0,
    fy=93.0,
    cx=40.4,
    cy=29.1,
)
NONE = ConvertOptions(poses="none")


@pytest.mark.parametrize("name", ["", "0", "1"])
def test_equal_names_that_name_no_frame_prove_nothing(tmp_path, box, name):
    """Their cameras tell whether depth is registered; where they do not, that is said."""
    names = (name, name)
    report = convert(
        record(tmp_path / "a.bag", box, frames=names),
        tmp_path / "a",
        options=NONE,
    )
    assert (
        report.notes[1] == "depth is taken as registered to colour (the cameras of both are equal)"
    )
    path = record(tmp_path / "b.bag", box, frames=names, infos=("colour",))
    report = convert(path, tmp_path / "b", options=NONE)
    assert "which nothing in the bag says; if it is not, give --depth-intrinsics" in report.notes[1]
    path = record(tmp_path / "c.bag", box, frames=names, depth_camera=NARROW)
    report = convert(path, tmp_path / "c", options=NONE)
    assert "WITHOUT their offset, since the frames of the images have no names" in report.notes[1]
    assert_on_walls(tmp_path / "c", box)


def test_another_frame_without_a_camera_is_asked_for(tmp_path, box):
    path = record(
        tmp_path / "a.bag",
        box,
        frames=(FRAME, "depth_optical"),
        infos=("colour",),
    )
    with pytest.raises(
        OptionNeeded, match=r"in the frame 'depth_optical' and colour in 'camera_optical', and no"
    ):
        convert(path, tmp_path / "out", options=NONE)
    report = convert(
        path, tmp_path / "out", options=ConvertOptions(poses="none", depth_intrinsics="colour")
    )
    assert report.notes[1] == "depth is taken as registered to colour (--depth-intrinsics)"


def test_one_frame_and_another_camera_is_resampled(tmp_path, box):
    path = record(tmp_path / "a.bag", box, depth_camera=NARROW)
    report = convert(path, tmp_path / "out", options=NONE)
    assert "resampled to colour's camera" in report.notes[1]
    assert_on_walls(tmp_path / "out", box)


def test_a_part_of_the_sensor_has_the_principal_point_of_the_part(tmp_path, box):
    """camera_info is of the whole sensor, and roi says which part of it the images show (REP
    104)."""
    whole = Camera(
        width=100,
        height=90,
        fx=NARROW.fx,
        fy=NARROW.fy,
        cx=NARROW.cx + 12,
        cy=NARROW.cy + 20,
    )
    path = record(
        tmp_path / "a.bag",
        box,
        depth_camera=NARROW,
        said=whole,
        roi=(12, 20, 80, 60),
    )
    convert(path, tmp_path / "out", options=NONE)
    assert_on_walls(tmp_path / "out", box)


def test_an_uncalibrated_camera_has_no_intrinsics(tmp_path, box):
    """A driver without a calibration publishes a camera_info of zeros."""

    def more(bag, i, t, T):
        nothing = Camera(
            width=64,
            height=48,
            fx=1.0,
            fy=1.0,
            cx=0.5,
            cy=0.5,
        )
        bag.info("/cam/color/camera_info", t, FRAME, nothing, zeros=True)

    path = record(tmp_path / "a.bag", box, infos=(), more=more)
    with pytest.raises(OptionNeeded, match="does not contain the camera's intrinsics"):
        convert(path, tmp_path / "out", options=NONE)


def test_floating_point_in_millimetres_names_the_option(tmp_path, box):
    """32FC1 is in metres by the standard, and some drivers publish millimetres."""
    with Bag(tmp_path / "mm.bag", 1) as bag:
        for i, T in enumerate(box.poses(2)):
            rgb, depth_m = box.render(T)
            bag.info("/cam/camera_info", 1.0 + i, FRAME, box.camera)
            bag.image("/cam/color", 1.0 + i, FRAME, "rgb8", rgb)
            bag.image(
                "/cam/depth",
                1.0 + i,
                FRAME,
                "32FC1",
                (1000 * depth_m).astype(np.float32),
            )
    with pytest.raises(
        SequenceError,
        match=r"the median is \d+\.?\d* m, .*--depth-scale 1000 if it is in millimetres",
    ):
        convert(tmp_path / "mm.bag", tmp_path / "out", options=NONE)
    convert(
        tmp_path / "mm.bag",
        tmp_path / "out",
        options=ConvertOptions(poses="none", depth_scale=1000.0),
    )
    truth = box.render(box.poses(2)[0])[1]
    assert np.abs(folder(tmp_path / "out", poses=False)[0].depth_m.numpy() - truth).max() < 6e-4


BESIDE = se3.exp(torch.tensor([0.02, 0.003, -0.004, 0.01, -0.015, 0.005], dtype=torch.float64))


@pytest.mark.parametrize("share", [0.25, 0.33, 0.5, 1.0, 2.0])
def test_registered_depth_covers_colour_at_every_ratio_of_sizes(tmp_path, box, share):
    """What the converter writes, the reader reads: 11 % of the pixels had depth at a third of the
    resolution."""
    margin = 12
    c = box.camera.resized(round(share * 64), round(share * 48))
    wide = Camera(
        width=c.width + 2 * margin,
        height=c.height + 2 * margin,
        fx=c.fx,
        fy=c.fy,
        cx=c.cx + margin,
        cy=c.cy + margin,
    )
    path = record(
        tmp_path / "a.bag",
        box,
        frames=("colour", "depth"),
        depth_camera=wide,
        T=BESIDE,
        more=lambda bag, i, t, T: bag.tf("/tf_static", t, "colour", "depth", BESIDE),
    )
    report = convert(path, tmp_path / "out", options=NONE)
    assert "depth (depth) was registered to colour (colour) by tf_static" in report.notes
    assert_on_walls(tmp_path / "out", box, off=0.003 + 0.004 / share, covered=1.0)


def assert_on_walls(out, box, off=0.006, covered=0.5):
    """Depth of every frame is that of the box as colour sees it."""
    for frame, T in zip(
        folder(out, poses=False),
        box.poses(4),
        strict=True,
    ):
        known = frame.depth_m > 0
        assert float(known.float().mean()) >= covered
        error = (frame.depth_m / torch.from_numpy(box.render(T)[1]) - 1)[known]
        assert float(error.abs().median()) < off
        assert abs(float(error.mean())) < 0.003


@pytest.fixture
def bag_folder(tmp_path, box):
    """A ROS 2 bag in sqlite, as recorded: a folder with metadata.yaml and its file."""
    with Bag(tmp_path / "scan", 2) as bag:
        for i, T in enumerate(box.poses(3)):
            t = 1.0 + 0.1 * i
            bag.info("/cam/color/camera_info", t, FRAME, box.camera)
            bag.image("/cam/color/image_raw", t, FRAME, "rgb8", box.render(T)[0])
            bag.image(
                "/cam/depth/image_raw",
                t,
                FRAME,
                "16UC1",
                np.rint(1000 * box.render(T)[1]).astype(np.uint16),
            )
    return tmp_path / "scan"


def test_a_bag_is_converted_inside_its_own_folder(bag_folder, monkeypatch):
    """Its temporary folder, and whatever else lies there, is no part of the bag."""
    monkeypatch.chdir(bag_folder)
    (bag_folder / "converted").mkdir()
    (bag_folder / "notes.txt").write_text("of the walk")
    source = next(bag_folder.glob("*.db3")).name
    for given, out in ((source, "out"), (".", "again"), (bag_folder, "converted/scan")):
        assert convert(given, out, options=NONE).frames == 3
    assert not list(bag_folder.glob(".*.partial"))


def test_a_file_beside_a_bag_that_does_not_name_it_is_refused(bag_folder):
    shutil.copy(next(bag_folder.glob("*.db3")), bag_folder / "other.db3")
    with pytest.raises(
        SequenceError, match=r"metadata\.yaml does not name other\.db3; it is of the bag scan"
    ):
        convert(bag_folder / "other.db3", bag_folder / "out", options=NONE)
    (bag_folder / "metadata.yaml").rename(bag_folder / "kept.yaml")
    with pytest.raises(
        SequenceError, match=r"metadata\.yaml does not exist; .*'ros2 bag reindex' makes one"
    ):
        convert(bag_folder / "other.db3", bag_folder / "out", options=NONE)
    (bag_folder / "metadata.yaml").write_text("rosbag2_bagfile_information: 3")
    with pytest.raises(
        SequenceError, match=r"metadata\.yaml is not readable as the metadata\.yaml of a ROS 2 bag"
    ):
        convert(bag_folder, bag_folder / "out", options=NONE)
