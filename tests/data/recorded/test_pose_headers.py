"""What headers and comments of files with poses say: direction and unit."""

from pathlib import Path

import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.recorded.pose_headers import check_direction, metres_per_unit
from gsfusion_nb.data.recorded.poses import poses_of_images


@pytest.mark.parametrize(
    "header",
    [
        "# timestamp tx ty tz qx qy qz qw (world to camera)",
        "# T_cw: timestamp tx ty tz qx qy qz qw",
        "% world2cam",
        "#  cam_from_world, OpenCV",
        "# view matrices, one a line",
        "\ufeffname,w2c",
    ],
)
def test_a_header_that_says_world_to_camera_is_refused(header):
    with pytest.raises(SequenceError, match=r"poses\.txt: .* says .* world-to-camera; expected"):
        check_direction(header, Path("poses.txt"))


@pytest.mark.parametrize(
    ("header", "named"),
    [
        ("# OpenGL camera-to-world", "other axes than OpenCV's"),
        ("# camera poses, y-up", "other axes than OpenCV's"),
        ("#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "a COLMAP model"),
    ],
)
def test_a_header_of_other_axes_is_refused(header, named):
    with pytest.raises(SequenceError, match=named):
        check_direction(header, Path("poses.txt"))


@pytest.mark.parametrize(
    "line",
    [
        "# axes of OpenCV, turned from OpenGL's",
        "# timestamp tx ty tz qx qy qz qw",
        "# camera-to-world, not world-to-camera",
        "# T_WC of the camera",
        "# file: rgbd_dataset_freiburg1_xyz.bag",
        "0.5 1 2 3 0 0 0 1",
        "#timestamp, p_RS_R_x [m], q_RS_w [], v_RS_R_x [m s^-1]",
    ],
)
def test_other_lines_are_not(line):
    check_direction(line, Path("poses.txt"))


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("# timestamp tx[mm] ty[mm] tz[mm] qx qy qz qw", 0.001),
        ("timestamp,x_mm,y_mm,z_mm,qx,qy,qz,qw", 0.001),
        ("# positions in centimetres", 0.01),
        ("# unit: inches", 0.0254),
        ("# translation (ft)", 0.3048),
        ("# timestamp tx ty tz qx qy qz qw", None),
        ("#timestamp, p_RS_R_x [m], p_RS_R_y [m]", None),
        ("# accuracy of the motion capture: 1 mm", None),
        ("1 2 3 mm", None),
    ],
)
def test_the_unit_of_positions_is_that_of_the_header(header, unit):
    assert metres_per_unit(["", header, "0 1 2 3 0 0 0 1"]) == unit


@pytest.mark.parametrize(
    ("header", "named"),
    [
        ("# rows of w2c", "world-to-camera"),
        ("# units: mm", "one unit of its positions is 0.001 m; expected metres"),
    ],
)
def test_the_plain_layout_refuses_both(tmp_path, header, named):
    file = tmp_path / "poses.txt"
    file.write_text(header + "\n" + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(SequenceError, match=named):
        poses_of_images(file, [Path("000000.png")])
