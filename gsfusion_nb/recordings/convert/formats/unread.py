"""Recordings of other programs that are not read: whose they are, and how to get something that
is."""

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

_ZED = (
    "a recording of a ZED",
    "ZED_SVO_Export writes left*.png and depth*.png in millimetres, which is read",
)
_HDF5 = ("HDF5", "write colour and depth as images, depth along the camera's axis, and poses.txt")
_MODEL = ("a model, not a recording", "export the raw data of the scan")
_VIDEO = ("a video, which holds no depth", "give the folder that holds it and the depth images")
_ARCHIVE = ("an archive", "unpack it first")
_STRAY_FRAMES = "mkdir rgb && ffmpeg -i rgb.mp4 -start_number 0 rgb/%06d.jpg"
_BY_SUFFIX: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        ".mkv": (
            "a recording of Azure Kinect or another camera",
            "Open3D's azure_kinect_mkv_reader writes color/, depth/ and intrinsic.json, which is "
            "read",
        ),
        ".svo": _ZED,
        ".svo2": _ZED,
        ".db": (
            "a database of RTAB-Map",
            "rtabmap-export --images_id --poses_camera writes images, calibrations and poses of "
            "the camera",
        ),
        ".oni": (
            "a recording of OpenNI",
            "its player or Open3D writes color/ and depth/ as images",
        ),
        ".klg": (
            "a log of Kintinuous or ElasticFusion",
            "tools such as klg_to_png write images as in TUM's benchmark",
        ),
        ".vrs": (
            "a recording of Project Aria",
            "the glasses have no depth camera; export images of synthetic scenes",
        ),
        ".hdf5": _HDF5,
        ".h5": _HDF5,
        ".mp4": _VIDEO,
        ".mov": _VIDEO,
        ".usdz": _MODEL,
        ".glb": _MODEL,
        ".ply": _MODEL,
        ".zip": _ARCHIVE,
        ".tgz": _ARCHIVE,
        ".gz": _ARCHIVE,
        ".tar": _ARCHIVE,
        ".7z": _ARCHIVE,
    }
)
"""End of a file's name -> what it is, and what to do."""
_VIDEOS = ("*.mp4", "*.mov", "*.m4v", "*.avi")


def unread_recording(path: Path) -> str:
    """A sentence on a recording of a program that is known but not read; empty for others."""
    if path.is_file():
        what, advice = _BY_SUFFIX.get(path.suffix.lower(), ("", ""))
        return f"{path} is {what}, which is not read; {advice}" if what else ""
    if not path.is_dir():
        return ""
    folder = _unread_folder(path)
    if folder:
        return f"{path} is {folder}"
    members = (
        file
        for file in sorted(path.iterdir())
        if file.suffix.lower() in _BY_SUFFIX and file.is_file()
    )
    sole_file = next(
        (
            file
            for file in members
            if file.suffix.lower() not in (".mp4", ".mov", ".ply", ".glb", ".gz")
        ),
        None,
    )
    has_depth = any(path.glob("*depth*"))
    return "" if sole_file is None or has_depth else unread_recording(sole_file)


def _unread_folder(path: Path) -> str:
    """What a folder of a known program is, and what to do; empty for others."""
    if next(path.glob("mav0/cam*"), None) is not None:
        return (
            "a recording of EuRoC or TUM-VI, of grey cameras without depth; RGB-D mapping needs "
            "depth: compute it from the two cameras, and write it beside the images of one"
        )
    if next(path.glob("**/*.depth_meters.hdf5"), None) is not None:
        return (
            "a scene of Hypersim, whose depth is HDF5 and the distance from the camera, not along "
            "its axis; write z-depth as images, and poses.txt"
        )
    if (path / "pose_intrinsic_imu.json").is_file():
        return (
            "a phone's recording of ScanNet++, whose poses are not read from "
            "pose_intrinsic_imu.json; the data set's "
            "toolbox writes files of COLMAP or nerfstudio, which are read with --depth"
        )
    if (path / "airsim_rec.txt").is_file():
        return (
            "a recording of AirSim, whose poses have its axes (x forward, y right, z down) and "
            "wxyz quaternions; write "
            "them as camera-to-world with OpenCV axes into poses.txt, and remove airsim_rec.txt"
        )
    named_as_nyu = any(re.match(r"d-\d+\.\d+-\d+\.pgm", file.name) for file in path.glob("d-*.pgm"))
    if named_as_nyu:
        return (
            "raw data of NYU Depth V2, whose depth is disparity with swapped bytes, of another "
            "camera than colour; its toolbox (get_projected_depth) writes depth that is read"
        )
    return ""


def video_of_colour(path: Path) -> str:
    """What to do with a folder of depth whose colour is a video; empty where there is none."""
    video = next((file for pattern in _VIDEOS for file in sorted(path.glob(pattern))), None)
    if video is None:
        return ""
    frames = _STRAY_FRAMES.replace("rgb.mp4", video.name)
    return f"{video} is a video: write its frames as images, in that folder: {frames}"
