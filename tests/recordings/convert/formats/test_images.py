"""Folders of images as people write them: names of files and folders, poses and intrinsics."""

import json

import cv2
import numpy as np
import pytest

from gsfusion_nb.data import BadFrameError, SequenceError, folder
from gsfusion_nb.recordings.convert import ConvertOptions, convert, depth_files, detect_format
from gsfusion_nb.recordings.convert.depth_files import check_exr, read_depth_file
from gsfusion_nb.recordings.convert.formats import images
from gsfusion_nb.recordings.convert.recording import OptionNeeded


def write(root, takes, colour="color/{}.jpg", depth="depth/{}.png"):
    for i in range(len(takes)):
        picture = takes.jpeg(i) if colour.endswith("jpg") else takes.png(i)
        takes.write(root / colour.format(i), picture)
        takes.write(root / depth.format(i), takes.depth_png(i))
    return root


def K(takes):
    c = takes.camera
    return np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])


def poses_txt(root, T):
    np.savetxt(root / "poses.txt", T.reshape(len(T), 16))


def traj_txt(root, T):
    np.savetxt(root / "traj.txt", T.reshape(len(T), 16)[:, :12])


def four_rows(root, T):
    np.savetxt(root / "poses.txt", T.reshape(-1, 4))


def pos_npy(root, T):
    np.save(root / "pos.npy", T)


def one_file_each(root, T):
    (root / "pose").mkdir()
    for i, pose in enumerate(T):
        np.savetxt(root / f"pose/{i}.txt", pose)


def named_rows(root, T):
    lines = [
        f"{i}.jpg {' '.join(str(v) for v in pose.ravel())}" for i, pose in reversed([*enumerate(T)])
    ]
    (root / "poses.txt").write_text("\n".join(lines))


@pytest.mark.parametrize(
    "write_poses", [poses_txt, traj_txt, four_rows, pos_npy, one_file_each, named_rows]
)
def test_poses(tmp_path, takes, write_poses):
    root = write(tmp_path / "scan", takes)
    write_poses(root, takes.T_WC.numpy())
    np.savetxt(root / "K.txt", K(takes))
    assert detect_format(root) == "images"
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", rgb=3)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_colour_of_12_bits_in_16(tmp_path, takes, suffix):
    root = write(tmp_path / "scan", takes, colour=f"color/{{}}.{suffix}")
    for i, rgb in enumerate(takes.rgb):
        deep = rgb[..., ::-1].astype(np.uint16) * 16
        cv2.imwrite(str(root / f"color/{i}.{suffix}"), deep)
    poses_txt(root, takes.T_WC.numpy())
    np.savetxt(root / "K.txt", K(takes))
    convert(root, tmp_path / "out", options=ConvertOptions(colour_bits=12))
    takes.check(tmp_path / "out")
    with pytest.raises(SequenceError, match=r"holds the value .* expected colour_bits of"):
        convert(root, tmp_path / "fewer", options=ConvertOptions(colour_bits=10))
    with pytest.raises(SequenceError, match="colour_bits must be 0, or 8 to 16, got 4"):
        ConvertOptions(colour_bits=4)


@pytest.mark.parametrize("file", ["poses.txt", "pos.npy"])
def test_matrices_that_are_stored_column_by_column_are_refused(tmp_path, takes, file):
    """Their rotation is rigid too, but that of the world to the camera, and their position is
    lost."""
    root = write(tmp_path / "scan", takes)
    columns = takes.T_WC.numpy().transpose(0, 2, 1)
    (np.save if file.endswith("npy") else np.savetxt)(root / file, columns.reshape(-1, 16))
    np.savetxt(root / "K.txt", K(takes))
    with pytest.raises(SequenceError, match=rf"{file}: pose 0 must have the last row 0 0 0 1"):
        convert(root, tmp_path / "out", options=ConvertOptions(poses=str(root / file)))


def test_a_list_of_quaternions_without_names_says_their_order(tmp_path, takes):
    root = write(tmp_path / "scan", takes)
    rows = [takes.tum_row(i) for i in range(len(takes))]
    np.savetxt(root / "poses.txt", np.array(rows, dtype=float))
    np.savetxt(root / "K.txt", K(takes))
    report = convert(root, tmp_path / "out")
    assert any("quaternions taken as x y z w" in note for note in report.notes)
    takes.check(tmp_path / "out", rgb=3, pose=1e-5)


def test_frame_numbers_pair_images_and_are_no_times(tmp_path, takes):
    """Frames chosen out of a video, of which one colour and another depth image are lost: nothing
    else pairs them."""
    numbers = ["000112", "000120", "000133", "000141"]
    root = tmp_path / "scan"
    for i, number in enumerate(numbers):
        if i != 0:
            takes.write(root / f"rgb/frame_{number}.png", takes.png(i))
        if i != 1:
            takes.write(root / f"depth/frame_{number}.png", takes.depth_png(i))
    lines = [
        f"frame_{n}.png {' '.join(str(v) for v in T.ravel())}"
        for n, T in zip(numbers, takes.T_WC.numpy(), strict=True)
    ]
    (root / "poses.txt").write_text("\n".join(lines))
    np.savetxt(root / "K.txt", K(takes))
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", frames=[2, 3])
    assert report.dropped == {"no colour image of its number": 1, "no depth image of its number": 1}
    assert "fps" not in json.loads((tmp_path / "out/intrinsics.json").read_text())


def test_numbers_that_may_be_times_are_not_paired_by_a_tolerance(tmp_path, takes):
    """Names 30 apart, without leading zeros: milliseconds, or frames. That is said, and only equal
    numbers pair."""
    root = tmp_path / "scan"
    for i, number in enumerate((100, 130, 161, 190)):
        takes.write(root / f"rgb/{number}.png", takes.png(i))
        takes.write(root / f"depth/{number + 15 * (i == 2)}.png", takes.depth_png(i))
    np.savetxt(root / "K.txt", K(takes))
    report = convert(root, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert report.frames == 3
    assert any(
        "taken as times in ms" in note and "--image-time-unit none" in note for note in report.notes
    )


def test_the_column_of_frames_says_whose_a_pose_is(tmp_path, takes):
    """StrayScanner's odometry.csv: times that the images do not have, and the number of each
    image."""
    root = write(tmp_path / "scan", takes, colour="rgb/00000{}.png", depth="depth/00000{}.png")
    rows = [
        f"{1000.5 + i / 60:.6f}, {i:06d}, {', '.join(map(str, takes.tum_row(i)))}"
        for i in range(len(takes))
    ]
    (root / "odometry.csv").write_text(
        "\n".join(["timestamp, frame, x, y, z, qx, qy, qz, qw", *rows])
    )
    np.savetxt(root / "K.txt", K(takes))
    report = convert(
        root, tmp_path / "out", options=ConvertOptions(poses=str(root / "odometry.csv"))
    )
    takes.check(tmp_path / "out", pose=1e-5)
    times = [frame.timestamp_s for frame in folder(tmp_path / "out")]
    assert times == pytest.approx([1000.5 + i / 60 for i in range(4)])
    assert any("its column of frames says whose they are" in note for note in report.notes)


def numbers(root, matrix):
    (root / "intrinsics.txt").write_text(
        f"{matrix[0, 0]} {matrix[1, 1]} {matrix[0, 2]} {matrix[1, 2]}"
    )


def named(root, matrix):
    lines = zip(
        ("fx", "fy", "cx", "cy"),
        (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
        strict=True,
    )
    (root / "camera.yaml").write_text(
        "%YAML:1.0\n" + "\n".join(f"Camera.{name}: {value}" for name, value in lines)
    )


def array(root, matrix):
    np.save(root / "intrinsics.npy", matrix)


def rows_in_json(root, matrix):
    (root / "intrinsics.json").write_text(json.dumps({"K": matrix.tolist()}))


@pytest.mark.parametrize("write_intrinsics", [numbers, named, array, rows_in_json])
@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        ("colour/{}.png", "depth/{}.png"),
        ("images/img_{}.png", "depths/d{}.png"),
        ("color_{}.png", "depth_{}.png"),
        ("data/frame-00000{}.color.png", "data/frame-00000{}.depth.png"),
    ],
)
def test_names_and_intrinsics(tmp_path, takes, colour, depth, write_intrinsics):
    root = write(tmp_path / "scan", takes, colour, depth)
    write_intrinsics(root, K(takes))
    pos_npy(root, takes.T_WC.numpy())
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_what_is_missing_is_asked_for_one_by_one(tmp_path, takes):
    root = write(tmp_path / "scan", takes, "a/{}.png")
    write(root, takes, "b/{}.png", "depth_filtered/{}.png")
    answers = {
        "depth": ("depth_filtered", ("depth/*.png", "depth_filtered/*.png")),
        "colour": ("a/*.png", ("a/*.png", "b/*.png")),
        "poses": ("none", ()),
        "intrinsics": ("41.6", ()),
    }
    given = {}
    for option, (answer, choices) in answers.items():
        with pytest.raises(OptionNeeded, match=f"--{option}") as asked:
            convert(root, tmp_path / "out", options=ConvertOptions(**given))
        assert (asked.value.option, asked.value.choices) == (option, choices)
        given[option] = answer
    report = convert(root, tmp_path / "out", options=ConvertOptions(**given))
    assert (report.camera.fx, report.camera.cx, report.has_poses) == (41.6, 30, False)


def test_fewer_poses_than_frames_belong_to_nobody(tmp_path, takes):
    root = write(tmp_path / "scan", takes)
    pos_npy(root, takes.T_WC.numpy()[:3])
    with pytest.raises(
        SequenceError,
        match=r"pos\.npy holds 3 poses; expected 4, one per frame.*--stop 3;.*--poses none",
    ):
        convert(root, tmp_path / "out", options=ConvertOptions(intrinsics="40"))
    pos_npy(root, takes.T_WC.numpy()[::2])
    with pytest.raises(
        SequenceError, match=r"holds 2 poses.*--stop 2; of every 2th frame: --every 2"
    ):
        convert(root, tmp_path / "out", options=ConvertOptions(intrinsics="40"))


@pytest.mark.parametrize(
    ("chosen", "frames"),
    [({"stop": 2}, (0, 1)), ({"every": 2}, (0, 2)), ({"start": 2}, (2, 3))],
)
def test_as_many_poses_as_frames_are_converted(tmp_path, takes, chosen, frames):
    """200 poses of 1000 images: only the user can know whose they are."""
    root = write(tmp_path / "scan", takes)
    pos_npy(root, takes.T_WC.numpy()[list(frames)])
    np.savetxt(root / "K.txt", K(takes))
    report = convert(root, tmp_path / "out", options=ConvertOptions(**chosen))
    takes.check(tmp_path / "out", frames, rgb=3)
    assert any("2 poses, as many as frames are converted" in note for note in report.notes)


@pytest.mark.parametrize(
    ("first", "n_poses", "row"),
    [(5, 20, 5), (17, 20, 16)],
)
def test_numbers_of_images_choose_among_more_poses(tmp_path, takes, first, n_poses, row):
    """Images 5 to 8 of 20 poses count from 0, 17 to 20 from 1."""
    root = tmp_path / "scan"
    for i in range(len(takes)):
        takes.write(root / f"rgb/{first + i:06d}.png", takes.png(i))
        takes.write(root / f"depth/{first + i:06d}.png", takes.depth_png(i))
    T = np.tile(np.eye(4), (n_poses, 1, 1))
    T[row : row + 4] = takes.T_WC.numpy()
    pos_npy(root, T)
    np.savetxt(root / "K.txt", K(takes))
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")
    assert any(f"image {first} that of row {row}, counted from 0" in note for note in report.notes)


def test_eight_bits_have_lost_their_precision(tmp_path, takes):
    root = write(tmp_path / "scan", takes)
    for i in range(len(takes)):
        image = (takes.depth_m[i] * 40).astype(np.uint8)
        takes.write(root / f"depth/{i}.png", cv2.imencode(".png", image)[1].tobytes())
    with pytest.raises(SequenceError, match=r"0\.png holds depth in 8 bits, so precision was lost"):
        convert(root, tmp_path / "out")


def test_pictures_alone_and_confidences_are_no_depth(tmp_path, takes):
    root = tmp_path / "scan"
    for i in range(len(takes)):
        takes.write(root / f"rgb/{i}.png", takes.png(i))
        takes.write(root / f"confidence/{i}.png", takes.depth_png(i))
    assert not images.recognise(root)


def test_the_package_for_openexr_is_named_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        SequenceError, match=r"0\.exr is an OpenEXR file.*pip install 'gsfusion-nb\[exr\]'"
    ):
        check_exr(tmp_path / "0.exr")


def test_many_channels_of_an_openexr_file_are_not_unpacked(tmp_path, monkeypatch):
    OpenEXR = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    depth_m = np.full((40, 60), 1.5, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    few = dict.fromkeys("RGBZ", depth_m)
    OpenEXR.File(header, few).write(str(tmp_path / "few.exr"))
    OpenEXR.File(header, few | {"A": depth_m}).write(str(tmp_path / "many.exr"))
    monkeypatch.setattr(depth_files, "_EXR_VALUES", 4 * depth_m.size)
    np.testing.assert_array_equal(read_depth_file(tmp_path / "few.exr", 1.0), depth_m)
    with pytest.raises(BadFrameError, match=r"many\.exr claims 12,000 numbers .* most 9,600"):
        read_depth_file(tmp_path / "many.exr", 1.0)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("name", "focal_px", "scale"),
    [("redkitchen_mini48", 265.7, 1000.0), ("rgbd_dataset_freiburg1_xyz_excerpt", 517, 5000.0)],
)
def test_the_focal_length_of_real_recordings_is_estimated(
    shared_sequence, tmp_path, name, focal_px, scale
):
    options = ConvertOptions(poses="none", intrinsics="estimate", depth_scale=scale, every=12)
    report = convert(shared_sequence(name), tmp_path / "out", options=options)
    assert report.camera.fx == pytest.approx(focal_px, rel=0.05)


def test_a_focal_length_that_nothing_shows_is_asked_for(tmp_path, takes):
    root = write(tmp_path / "scan", takes)
    with pytest.raises(OptionNeeded, match="cannot be measured"):
        convert(root, tmp_path / "out", options=ConvertOptions(poses="none", intrinsics="estimate"))


def test_a_second_camera_of_a_calibration_is_told(tmp_path, takes):
    """Depth is taken as registered to colour; where the file says how the cameras stand, it is
    asked for."""
    root = write(tmp_path / "scan", takes)
    poses_txt(root, takes.T_WC.numpy())
    c = takes.camera
    colour = {"fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5}
    cameras = {"color": colour, "depth": colour | {"fx": 0.7 * c.fx}}
    (root / "calibration.json").write_text(json.dumps(cameras))
    notes = "; ".join(convert(root, tmp_path / "a").notes)
    assert "also holds the camera depth; depth is taken as registered to colour" in notes
    given = ConvertOptions(depth_intrinsics="colour")
    assert "also holds" not in "; ".join(convert(root, tmp_path / "b", options=given).notes)
    still = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 0]}
    (root / "calibration.json").write_text(json.dumps(cameras | {"extrinsics": still}))
    convert(root, tmp_path / "c")
    moved = still | {"translation": [0.015, 0, 0]}
    for name in ("depth_to_color", "T_color_depth", "extrinsics"):
        (root / "calibration.json").write_text(json.dumps(cameras | {name: moved}))
        with pytest.raises(SequenceError, match=f"{name} says where the depth camera stands"):
            convert(root, tmp_path / "d")
    convert(root, tmp_path / "d", options=given)


def test_depth_of_another_size_in_one_frame(tmp_path, takes):
    """The unit is measured on the frames that have the size of most."""
    root = write(tmp_path / "scan", takes)
    poses_txt(root, takes.T_WC.numpy())
    np.savetxt(root / "K.txt", K(takes))
    small = takes.depth_raw(3)[::2, ::2]
    takes.write(root / "depth/3.png", cv2.imencode(".png", small)[1].tobytes())
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    assert "1000 units a metre, measured by the camera's motion" in notes
    assert len(folder(tmp_path / "out")) == 4


def scan(root, takes):
    """A folder of images with its intrinsics, and without poses."""
    write(root, takes)
    np.savetxt(root / "K.txt", K(takes))
    return root


@pytest.mark.parametrize("comment", ["", "# "])
@pytest.mark.parametrize("order", ["wxyz", "xyzw", "first"])
def test_a_header_says_the_order_of_quaternions(tmp_path, takes, comment, order):
    root = scan(tmp_path / "scan", takes)
    rows = []
    for i in range(len(takes)):
        *t, x, y, z, w = takes.tum_row(i)
        rows.append({"wxyz": [*t, w, x, y, z], "xyzw": [*t, x, y, z, w], "first": [x, y, z, w, *t]})
    header = {
        "wxyz": "tx ty tz qw qx qy qz",
        "xyzw": "x y z qx qy qz qw",
        "first": "qx qy qz qw tx ty tz",
    }[order]
    lines = [comment + header, *(" ".join(map(str, row[order])) for row in rows)]
    (root / "poses.txt").write_text("\n".join(lines))
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    takes.check(tmp_path / "out", rgb=3)
    assert "--pose-quaternions" not in notes


@pytest.mark.parametrize("matrices", [True, False])
def test_numbers_of_poses_that_count_from_1(tmp_path, takes, matrices):
    root = scan(tmp_path / "scan", takes)
    lines = [
        f"{i + 1} {' '.join(map(str, T.ravel() if matrices else takes.tum_row(i)))}"
        for i, T in enumerate(takes.T_WC.numpy())
    ]
    if not matrices:
        lines.insert(0, "frame tx ty tz qx qy qz qw")
    (root / "poses.txt").write_text("\n".join(lines))
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    takes.check(tmp_path / "out", rgb=3)
    assert "numbers of the poses count from 1" in notes
    assert "no times" in notes


def test_two_poses_of_one_image_are_refused(tmp_path, takes):
    root = scan(tmp_path / "scan", takes)
    (root / "poses.txt").write_text(
        "\n".join(
            f"{max(i, 1)} {' '.join(map(str, T.ravel()))}" for i, T in enumerate(takes.T_WC.numpy())
        )
    )
    with pytest.raises(SequenceError, match=r"poses\.txt holds two poses of 1; expected one"):
        convert(root, tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("name,x,y,z,roll,pitch,yaw\n0,1,2,3,4,5,6\n", "names columns that are not known"),
        ("# world to camera\n" + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 4, "world-to-camera"),
        ("# OpenGL\n" + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 4, "other axes than OpenCV's"),
    ],
)
def test_what_poses_are_not_is_said_by_their_header(tmp_path, takes, text, named):
    root = scan(tmp_path / "scan", takes)
    (root / "poses.txt").write_text(text)
    with pytest.raises(SequenceError, match=named) as error:
        convert(root, tmp_path / "out")
    assert "damaged" not in str(error.value)


def test_poses_in_brackets_and_lost_ones_of_windows(tmp_path, takes):
    root = scan(tmp_path / "scan", takes)
    lines = [str(T.tolist()) for T in takes.T_WC.numpy()]
    lines[2] = " ".join(["-1.#IND"] * 12 + ["0", "0", "0", "1"])
    (root / "poses.txt").write_text("\n".join(lines))
    report = convert(root, tmp_path / "out")
    assert report.dropped == {"tracking was lost (pose is NaN or infinite)": 1}
    takes.check(tmp_path / "out", (0, 1, 3), rgb=3)


def test_another_calibration_in_the_folder_is_named(tmp_path, takes):
    root = scan(tmp_path / "scan", takes)
    poses_txt(root, takes.T_WC.numpy())
    np.savetxt(root / "intrinsics.txt", K(takes))
    assert "is not used" not in "; ".join(convert(root, tmp_path / "same").notes)
    np.savetxt(root / "intrinsics.txt", K(takes) * [[1.1], [1.1], [1]])
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    assert "intrinsics.txt gives other intrinsics, fx" in notes
    assert "intrinsics from" in notes


def test_images_that_are_numbered_from_0_and_from_1_are_told(tmp_path, takes):
    root = scan(tmp_path / "scan", takes)
    (root / "depth").rename(root / "old")
    (root / "depth").mkdir()
    for i in range(len(takes)):
        (root / f"old/{i}.png").rename(root / f"depth/{i + 1}.png")
    (root / "old").rmdir()
    given = ConvertOptions(poses="none", depth_scale=1000.0)
    report = convert(root, tmp_path / "out", options=given)
    assert "colour images are numbered from 0 and depth images from 1" in "; ".join(report.notes)
    assert report.dropped == {
        "no colour image of its number": 1,
        "no depth image of its number": 1,
    }
    (root / "depth/4.png").unlink()
    report = convert(root, tmp_path / "fewer", options=given)
    assert "numbered from 0" not in "; ".join(report.notes)
