"""Separate trajectories: every way of writing them, interpolation, gaps, extrinsics, and what is
refused."""

import math
from dataclasses import replace

import cv2
import pytest
import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.recorded.poses import poses_of_images
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, convert, read_trajectory

HALF = math.sqrt(0.5)
# at 10 s: origin, no rotation; at 11 s: one metre along x, a quarter turn about z
ROWS = [(10.0, 0, 0, 0, 0, 0, 0, 1), (11.0, 1, 0, 0, 0, 0, HALF, HALF)]


def in_ns(order):
    def lines(rows):
        return "\n".join(
            ", ".join([str(round(r[0] * 1e9)), *(str(r[1 + k]) for k in order)]) for r in rows
        )

    return lines


XYZW = (0, 1, 2, 3, 4, 5, 6)
WXYZ = (0, 1, 2, 6, 3, 4, 5)
OKVIS = "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x, b_g_x\n"
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x []\n"
)


def okvis(rows):
    return OKVIS + "\n".join(line + ", 0.1, 0.2" for line in in_ns(XYZW)(rows).splitlines())


def euroc(rows):
    return EUROC + "\n".join(line + ",0.1" for line in in_ns(WXYZ)(rows).splitlines())


def euroc_without_header(rows):
    return "\n".join(line + ",0" * 9 for line in in_ns(WXYZ)(rows).splitlines())


def tum(rows):
    return "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n" + "\n".join(
        " ".join(map(str, r)) for r in rows
    )


def orb_slam_ns(rows):
    return "\n".join(" ".join([f"{r[0] * 1e9:.6f}", *(f"{v:.7f}" for v in r[1:])]) for r in rows)


@pytest.mark.parametrize("write", [tum, okvis, euroc, euroc_without_header, orb_slam_ns])
def test_formats_and_interpolation(tmp_path, write):
    path = tmp_path / "poses.txt"
    path.write_text(write(ROWS))
    trajectory = read_trajectory(path, max_gap_s=1.5)
    assert trajectory.stamps_s.tolist() == [10.0, 11.0]
    T = trajectory.pose_at(10.5)  # half way: half a metre, an eighth of a turn
    assert T is not None
    eighth = torch.tensor(
        [[HALF, -HALF, 0], [HALF, HALF, 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    assert torch.allclose(T[:3, :3], eighth, atol=1e-6)
    assert torch.allclose(
        T[:3, 3],
        torch.tensor([0.5, 0, 0], dtype=torch.float64),
        atol=1e-6,
    )
    assert trajectory.pose_at(9.99) is None
    assert trajectory.pose_at(11.01) is None


def test_axis_and_angle_of_arkitscenes(tmp_path, takes):
    """Time, axis times angle and translation, world-to-camera; OpenCV's Rodrigues is the witness of
    the rotation."""
    T_CW = se3.inverse(takes.T_WC)
    lines = []
    for i in range(len(takes)):
        axis_angle = cv2.Rodrigues(T_CW[i, :3, :3].numpy())[0].ravel()
        values = [100.0 + 0.1 * i, *axis_angle, *T_CW[i, :3, 3].tolist()]
        lines.append(" ".join(f"{value:.12f}" for value in values))
        takes.write(tmp_path / f"scan/rgb/47331606_{100.0 + 0.1 * i:.3f}.png", takes.png(i))
        takes.write(tmp_path / f"scan/depth/47331606_{100.0 + 0.1 * i:.3f}.png", takes.depth_png(i))
    c = takes.camera
    pincam = tmp_path / "scan/rgb_intrinsics/47331606_100.000.pincam"
    pincam.parent.mkdir()
    pincam.write_text(f"{c.width} {c.height} {c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}")
    (tmp_path / "scan/lowres_wide.traj").write_text("\n".join(lines))
    convert(tmp_path / "scan", tmp_path / "out")
    takes.check(tmp_path / "out", pose=1e-6)
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    with pytest.raises(
        SequenceError, match=r"a quaternion of length 1, got one of length .*ARKitScenes"
    ):
        convert(
            tmp_path / "scan",
            tmp_path / "other",
            options=ConvertOptions(poses=str(tmp_path / "poses.txt")),
        )


def test_the_unit_of_a_trajectory_is_the_one_that_spans_the_frames(tmp_path):
    """2,000 to 8,000 may be milliseconds at 1 Hz, or microseconds at 1 kHz: the frames tell."""
    rows = [(1000.0 * i, 0.1 * i, 0, 0, 0, 0, 0, 1) for i in range(2, 9)]
    (tmp_path / "p.txt").write_text(tum(rows))
    assert "times read as ms" in read_trajectory(tmp_path / "p.txt").notes[-1]
    assert "times read as ms" in read_trajectory(tmp_path / "p.txt", frame_time_s=5.0).notes[-1]
    assert "times read as us" in read_trajectory(tmp_path / "p.txt", frame_time_s=0.005).notes[-1]


@pytest.mark.parametrize("separator", [" ", "; ", "\t"])
def test_decimal_commas_are_named(tmp_path, separator):
    """Read as separators, they would double the numbers."""
    row = separator.join(f"{v:.3f}".replace(".", ",") for v in ROWS[1])
    (tmp_path / "p.txt").write_text(f"{row}\n{row}\n")
    for read in (read_trajectory, lambda path: poses_of_images(path, [path])):
        with pytest.raises(
            SequenceError, match=r"p\.txt has decimal commas, '11,000.*write decimal points"
        ):
            read(tmp_path / "p.txt")
    whole = "1,2,3,4,5,6,7,8"  # commas that separate
    (tmp_path / "p.txt").write_text(f"{whole}\n")
    with pytest.raises(SequenceError, match="unit quaternion"):
        read_trajectory(tmp_path / "p.txt")


def test_lost_poses_are_left_out(tmp_path):
    (tmp_path / "p.txt").write_text(tum([ROWS[0], (10.5, *[math.nan] * 7), ROWS[1]]))
    trajectory = read_trajectory(tmp_path / "p.txt")
    assert len(trajectory.T_world_body) == 2
    assert "1 of 3 poses are NaN and count as lost" in trajectory.notes[0]


@pytest.mark.parametrize(
    "text",
    ["", tum(ROWS[::-1]), "1 2 3\n", "1 0 0 0 0 0 0 2\n", tum([(1.0, *[math.nan] * 7)])],
)
def test_bad_files(tmp_path, text):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(SequenceError, match=r"p\.txt"):
        read_trajectory(tmp_path / "p.txt")


@pytest.mark.parametrize("text", ["f1.png,0,0,0,1\n", "t,roll,pitch,yaw\n1,0,0,0\n"])
def test_rows_of_something_else_are_not_called_damaged(tmp_path, text):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(SequenceError, match=r"'(f1\.png|1,0,0).*'name tx ty tz") as error:
        read_trajectory(tmp_path / "p.csv")
    assert "damaged" not in str(error.value)


def rows_of(takes, *, w_first=False):
    rows = [takes.tum_row(i) for i in range(len(takes))]
    return [[*r[:3], r[6], *r[3:6]] for r in rows] if w_first else rows


@pytest.mark.parametrize("w_first", [False, True])
@pytest.mark.parametrize("begins_with", ["time", "name", "nothing"])
def test_an_assumed_order_of_quaternions_is_told_and_can_be_changed(
    tmp_path, takes, w_first, begins_with
):
    options = tum_folder(tmp_path, takes)
    texts = [" ".join(map(str, row)) for row in rows_of(takes, w_first=w_first)]
    if begins_with != "nothing":
        suffix = ".png" * (begins_with == "name")
        texts = [f"{t:.6f}{suffix} {text}" for t, text in zip(takes.times_s, texts, strict=True)]
    (tmp_path / "p.txt").write_text("\n".join(texts))
    told = replace(options, pose_quaternions="wxyz" if w_first else "xyzw")
    report = convert(tmp_path, tmp_path / "told", options=told)
    takes.check(tmp_path / "told")
    assert not any("quaternions" in note for note in report.notes)
    if not w_first:
        report = convert(tmp_path, tmp_path / "out", options=options)
        takes.check(tmp_path / "out")
        (note,) = (note for note in report.notes if "quaternions" in note)
        assert note.endswith(
            "quaternions taken as x y z w; if w comes first: --pose-quaternions wxyz"
        )


@pytest.mark.parametrize("comment", ["", "# "])
def test_a_list_that_names_images_is_read_by_its_header(tmp_path, takes, comment):
    options = tum_folder(tmp_path, takes)
    rows = rows_of(takes, w_first=True)
    lines = [
        f'"rgb/{t:.6f}.png",{",".join(map(str, row))},1'
        for t, row in zip(takes.times_s, rows, strict=True)
    ]
    header = f"{comment}name,tx,ty,tz,qw,qx,qy,qz,camera\n"
    (tmp_path / "p.txt").write_text(header + "\n".join(lines[::-1]))
    report = convert(tmp_path, tmp_path / "out", options=options)
    takes.check(tmp_path / "out")
    assert not any("quaternions" in note for note in report.notes)
    with pytest.raises(SequenceError, match="its header says that quaternions are wxyz"):
        convert(tmp_path, tmp_path / "no", options=replace(options, pose_quaternions="xyzw"))
    (tmp_path / "p.txt").write_text(f"{header}{lines[0]}\n{lines[0]}\n")
    with pytest.raises(SequenceError, match="two poses of rgb/"):
        convert(tmp_path, tmp_path / "no", options=options)
    (tmp_path / "p.txt").write_text(f"{header}{lines[0]}\na.png,1,2\n")
    with pytest.raises(SequenceError, match=r"line 3 must hold the name of an image.* got 'a\.png"):
        convert(tmp_path, tmp_path / "no", options=options)


def tum_folder(root, takes):
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"rgb/{t:.6f}.png", takes.png(i))
        takes.write(root / f"depth/{t:.6f}.png", takes.depth_png(i, 5000))
    c = takes.camera
    return ConvertOptions(
        intrinsics=f"{c.fx} {c.fy} {c.cx} {c.cy}", pixel_centre=0.5, poses=str(root / "p.txt")
    )


@pytest.mark.parametrize("option", ["T_cam_body", "T_body_cam"])
def test_extrinsics_take_the_body_to_the_camera(tmp_path, takes, option):
    """Poses of a body at the frames' times, and between them, where the body's are known
    exactly."""
    options = tum_folder(tmp_path, takes)
    T_CB = se3.exp(torch.tensor([0.1, -0.2, 0.05, 0.3, 1.2, -0.4], dtype=torch.float64))
    moved = type(takes)(
        takes.camera,
        takes.rgb,
        takes.depth_m,
        takes.T_WC @ T_CB,
        takes.times_s,
    )
    rows = [(t, *moved.tum_row(i)) for i, t in enumerate(takes.times_s)]
    (tmp_path / "p.txt").write_text("\n".join(" ".join(f"{v:.12f}" for v in r) for r in rows))
    stored = T_CB if option == "T_cam_body" else se3.inverse(T_CB)
    (tmp_path / "T.txt").write_text(str(stored.tolist()))
    convert(
        tmp_path, tmp_path / "out", options=replace(options, **{option: str(tmp_path / "T.txt")})
    )
    takes.check(tmp_path / "out", depth_m=1.1e-4)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("# timestamp tx[mm] ty[mm] tz[mm] qw qx qy qz", 1000),
        ("time_s,x_cm,y_cm,z_cm,qw,qx,qy,qz", 100),
        ("# time (s), x (m), y (m), z (m), qw, qx, qy, qz", 1),
    ],
)
def test_a_header_says_the_unit_of_positions(tmp_path, takes, header, factor):
    """And its columns are found though the unit stands in their names."""
    import recorded_kinds as kinds

    root = kinds.tum_lists(tmp_path / "scan", takes)
    rows = []
    for i, time_s in enumerate(takes.times_s):
        x, y, z, *xyzw = takes.tum_row(i)
        values = [time_s, *(factor * v for v in (x, y, z)), xyzw[3], *xyzw[:3]]
        rows.append(("," if "," in header else " ").join(f"{v:.9f}" for v in values))
    (root / "groundtruth.txt").write_text("\n".join([header, *rows]))
    c = takes.camera
    given = ConvertOptions(
        intrinsics=f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}", depth_scale=5000.0
    )
    notes = "; ".join(convert(root, tmp_path / "out", options=given).notes)
    takes.check(tmp_path / "out", pose=1e-5)
    assert (f"positions were multiplied by {1 / factor:g}, as the header" in notes) == (factor > 1)
    assert "--pose-quaternions" not in notes


def test_frames_outside_and_in_gaps_are_dropped_and_counted(tmp_path, takes):
    options = tum_folder(tmp_path, takes)
    t = takes.times_s
    (tmp_path / "p.txt").write_text(
        tum([(t[0] + s, s, 0, 0, 0, 0, 0, 1) for s in (0.15, 0.25, 0.35, 0.52)])
    )
    report = convert(tmp_path, tmp_path / "out", options=options)
    assert report.frames == 2  # 0.2 and 0.4 s; 0 lies before, 0.6 behind
    assert report.dropped == {"the trajectory has no pose around its time": 2}
    report = convert(
        tmp_path, tmp_path / "b", options=replace(options, max_gap_s=0.15, time_offset_s=0.05)
    )
    # 0.05 lies before, 0.25 in a step of 0.1 s, 0.45 in one of 0.17 s, 0.65 behind
    assert report.frames == 1
    assert report.dropped == {"the trajectory has no pose around its time": 3}
