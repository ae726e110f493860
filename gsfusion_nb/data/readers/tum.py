"""TUM RGB-D benchmark (Sturm et al. 2012): a hand-held Kinect, poses from motion capture.

rgbd_dataset_freiburg1_desk/
  rgb.txt  depth.txt       lines "timestamp filename"
  groundtruth.txt          lines "timestamp tx ty tz qx qy qz qw", camera-to-world
  rgb/<timestamp>.png      depth/<timestamp>.png      16-bit, 5000 per metre
"""

import logging
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import shown
from ...errors import SequenceError, SequenceNotFoundError
from ...files import is_file, read_text
from ...geometry.pose_path import pose_at
from ...types import Camera
from ..lens import CameraModel, Undistorter
from ..recorded.files import calibration_in, given_name, natural_order, require, told_outside
from ..recorded.pose_headers import check_metres
from ..recorded.poses import checked_rows, matrices, no_poses, read_rows
from ..recorded.recorded_sequence import Layout, RecordedSequence
from ..recorded.stamps import judge_stamps
from ..recorded.time_doubts import warn_of_doubt
from ..recorded.times import associate, read_image_list

log = logging.getLogger(__name__)

LOOKS_FOR = ("rgb.txt", "depth.txt")
DEPTH_SCALE = 5000.0
MAX_TIME_DIFFERENCE_S = 0.02
MAX_POSE_GAP_S = 0.2


def _kinect(fx: float, fy: float, cx: float, cy: float) -> Camera:
    # the benchmark's calibration has pixel centres at integers
    return Camera(
        width=640,
        height=480,
        fx=fx,
        fy=fy,
        cx=cx + 0.5,
        cy=cy + 0.5,
    )


LENSES = {
    "freiburg1": CameraModel(
        _kinect(517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "freiburg2": CameraModel(
        _kinect(520.9, 521.0, 325.1, 249.7),
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    "freiburg3": CameraModel(_kinect(535.4, 539.2, 320.1, 247.6)),
}
"""Calibration of the three Kinects, from the benchmark's page; the third is already undistorted."""


def tum(
    path: str | Path,
    *,
    camera: str | Camera = "auto",
    undistort: bool = True,
    poses: bool = True,
) -> RecordedSequence:
    """Read a sequence of the TUM RGB-D benchmark (module docstring).

    Depth scale: 5000 per metre. Poses: camera-to-world, OpenCV axes. Pixel centres: integers in the
    benchmark's calibration, so 0.5 is added to ``cx`` and ``cy``. Each depth image goes with the
    colour image nearest in time, at most 0.02 s away, each used once; the pose is interpolated at
    the colour image's time between ground-truth poses at most 0.2 s apart, and ``open_sequence``
    moves the depth from its own time to it. Depth images without one of them are dropped, and the
    number is logged.

    Undistortion: fr1 and fr2 images are distorted, and colour and depth correspond pixel by pixel,
    because the driver registers depth to the distorted colour image; so both are undistorted, or
    neither. Without undistortion a pixel is 4.8 (fr1) or 4.7 (fr2) pixels off in the median and 12
    or 10 at the 95th percentile: 1.9 and 4.5 cm at 2 m. The released GSFusion does not undistort;
    ``undistort=False`` does the same.

    Args:
        path: Folder of the sequence.
        camera: "freiburg1", "freiburg2" or "freiburg3"; "auto" finds it in the name of a folder
            without a calibration of its own; or your own pinhole.
        poses: False for a recording without ``groundtruth.txt``; the camera must then be tracked.
        undistort: Remove the lens distortion of fr1 and fr2 from colour and depth. The field of
            view shrinks by 5 %.

    Raises:
        SequenceNotFoundError: the folder or one of its lists is missing.
        SequenceError: unknown camera, a damaged list, or no frame with colour, depth and pose.
    """
    root = Path(path)
    require(
        root,
        (*LOOKS_FOR, "groundtruth.txt") if poses else LOOKS_FOR,
        "tum",
        without_poses="groundtruth.txt",
    )
    lens = _lens(root, camera)
    undistorter = Undistorter(lens) if undistort and lens.distortion else None
    rgb_s, rgb_files = _stream(root / "rgb.txt")
    depth_s, depth_files = _stream(root / "depth.txt")
    pairs = associate(depth_s, rgb_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    triples = [(rgb_s[c], d, c) for d, c in pairs]
    doubt = warn_of_doubt(
        root / "rgb.txt",
        rgb_s,
        if_counted=f"gsfusion-nb convert {root} OUT --image-time-unit none",
    )
    if poses:
        frames = _with_poses(root / "groundtruth.txt", triples)
        T_WC = torch.stack([T for *_, T in frames]) if frames else no_poses(0)
    else:
        frames = [(*frame, None) for frame in triples]
        T_WC = no_poses(len(triples))
    if not frames:
        raise SequenceError(
            f"{root}: none of {len(depth_files)} depth images has a colour image within "
            f"{MAX_TIME_DIFFERENCE_S} s and poses around it at most {MAX_POSE_GAP_S} s apart; "
            "expected the time stamps of the three lists to overlap"
        )
    if len(frames) < len(depth_files):
        n_unpaired = len(depth_files) - len(pairs)
        n_without_pose = len(pairs) - len(frames)
        log.warning(
            "%s: dropped %d depth images without colour and %d without pose",
            root.name,
            n_unpaired,
            n_without_pose,
        )
    return RecordedSequence(
        name=given_name(root),
        camera=lens.camera if undistorter is None else undistorter.camera,
        rgb_files=[rgb_files[c] for _, _, c, _ in frames],
        depth_files=[depth_files[d] for _, d, _, _ in frames],
        timestamps_s=[t for t, *_ in frames],
        depth_times_s=[depth_s[d] for _, d, _, _ in frames],
        doubtful_times=doubt,
        poses=T_WC,
        has_poses=poses,
        pose_sources=[f"{root / 'groundtruth.txt'} at {t:.6f} s" for t, *_ in frames],
        depth_scale=DEPTH_SCALE,
        rectification=undistorter,
    )


def _lens(root: Path, camera: str | Camera) -> CameraModel:
    if isinstance(camera, Camera):
        return CameraModel(camera)
    name = camera
    if camera == "auto":
        name = benchmark_camera(root)
        if not name:
            raise SequenceError(
                f"{root}: the folder's name holds none of {', '.join(LENSES)}, or it has a "
                "calibration file; if it is the benchmark's: --reader camera=freiburg1; if "
                f"another camera's: gsfusion-nb convert {root} OUT"
            )
    if name not in LENSES:
        raise SequenceError(f"{root}: no TUM camera {shown(name)}; known: {', '.join(LENSES)}")
    return LENSES[name]


def benchmark_camera(folder: Path) -> str:
    """Which of ``LENSES`` the name of a folder holds, also in short (fr1); a link's own name
    counts. Empty if none, or if the folder holds a calibration of its own."""
    if calibration_in(folder) is not None:
        return ""
    names = (given_name(folder), folder.resolve().name)
    for name in names:
        for lens in LENSES:
            short = lens.replace("freiburg", "fr")
            if lens in name or short in name:
                return lens
    return ""


def _stream(path: Path) -> tuple[list[float], list[Path]]:
    """Times and files of a list with lines "timestamp filename"; those of a copy with only some of
    the images."""
    entries = [(t, file) for ((t, file),) in read_image_list(path) if is_file(file)]
    if not entries:
        raise SequenceNotFoundError(
            f"{path} names no image that is there; expected the images beside it"
        )
    stamps = [t for t, _ in entries]
    files = [file for _, file in entries]
    if note := told_outside(path.parent, files):
        log.warning("%s: %s", path, note)
    judgement = judge_stamps(stamps, names=[natural_order(f) for f in files], unit="s")
    if judgement.times_s is None:
        raise SequenceError(
            f"{path}: the numbers are not times in seconds: {judgement.why_not}; gsfusion-nb "
            f"convert {path.parent} OUT takes the frames in the order of the list"
        )
    return stamps, files


def _with_poses(
    path: Path, frames: list[tuple[float, int, int]]
) -> list[tuple[float, int, int, Float[Tensor, "4 4"]]]:
    """Frames whose time has a ground-truth pose, with that pose. Rows with NaN or infinities count
    as no pose."""
    what = "timestamp tx ty tz qx qy qz qw"
    table, notes = checked_rows(read_rows(path, 8, what), path)
    check_metres(read_text(path, what).splitlines(), path)
    for note in notes:
        log.warning("%s", note)
    stamps = table[:, 0].contiguous()
    poses = matrices(table[:, 1:])
    with_pose = []
    for t, d, c in frames:
        T_WC = pose_at(stamps, poses, t, max_gap_s=MAX_POSE_GAP_S)
        if T_WC is not None:
            with_pose.append((t, d, c, T_WC))
    return with_pose


LAYOUT = Layout(read=tum, looks_for=LOOKS_FOR)
