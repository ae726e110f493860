"""Small recordings as the documentation of cameras, apps and data sets describes them, made of the
built-in room.

Each maker writes one into a folder and returns what is given to ``convert``. ``docs/formats.md``
lists the kinds with the source of each.
"""

import json
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np

GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T GL has OpenGL's axes (y up, z backward) where T has OpenCV's."""
NED = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From OpenCV's axes to those of AirSim: x forward, y right, z down."""
T_RIG_DEPTH = np.array([[1.0, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""A depth camera 5 cm to the right of the colour camera."""


def matrix(takes: Any, size: int = 3) -> np.ndarray:
    """The camera matrix, with the centre of the first pixel at 0. [size, size]"""
    c = takes.camera
    K = np.eye(size)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = c.fx, c.fy, c.cx - 0.5, c.cy - 0.5
    return K


def camera_names(takes: Any) -> dict[str, float]:
    K = matrix(takes)
    return {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def write_images(
    root: Path,
    takes: Any,
    colour: str,
    depth: str,
    scale: float = 1000.0,
) -> Path:
    """Files of all frames; {} is the number of a frame, {t} its time."""
    for i, t in enumerate(takes.times_s):
        picture = takes.png(i) if colour.endswith("png") else takes.jpeg(i)
        takes.write(root / colour.format(i, t=t), picture)
        takes.write(root / depth.format(i, t=t), takes.depth_png(i, scale))
    return root


def write_text(path: Path, lines: list[str]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*lines, ""]))
    return path


def words(values: Any) -> str:
    return " ".join(f"{float(v):.9f}" for v in np.ravel(values))


def row_of(T: np.ndarray) -> list[float]:
    """tx ty tz qx qy qz qw of a pose."""
    from scipy.spatial.transform import Rotation

    return [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]


def poses(takes: Any) -> list[np.ndarray]:
    return list(takes.T_WC.numpy())


def tum_lists(root: Path, takes: Any, scale: float = 5000.0) -> Path:
    """rgb.txt, depth.txt and groundtruth.txt."""
    write_images(root, takes, "rgb/{t:.6f}.png", "depth/{t:.6f}.png", scale)
    for kind in ("rgb", "depth"):
        write_text(root / f"{kind}.txt", [f"{t:.6f} {kind}/{t:.6f}.png" for t in takes.times_s])
    rows = [f"{t:.6f} {words(takes.tum_row(i))}" for i, t in enumerate(takes.times_s)]
    write_text(root / "groundtruth.txt", ["# timestamp tx ty tz qx qy qz qw", *rows])
    return root


# ---- Phones --------------------------------------------------------------------------------------


def stray(root: Path, takes: Any, colour: bool = True) -> Path:
    """StrayScanner: depth and confidence by number, camera_matrix.csv, odometry.csv; colour is a
    video."""
    write_images(root, takes, "rgb/{:06d}.jpg", "depth/{:06d}.png")
    if not colour:
        for file in (root / "rgb").iterdir():
            file.unlink()
        (root / "rgb").rmdir()
    (root / "rgb.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    for i in range(len(takes)):
        confident = np.full(takes.depth_m[i].shape, 2, np.uint8)
        takes.write(root / f"confidence/{i:06d}.png", cv2.imencode(".png", confident)[1].tobytes())
    np.savetxt(root / "camera_matrix.csv", matrix(takes), delimiter=", ")
    rows = [
        f"{1000.5 + i / 60:.6f}, {i:06d}, {', '.join(map(str, takes.tum_row(i)))}"
        for i in range(len(takes))
    ]
    write_text(root / "odometry.csv", ["timestamp, frame, x, y, z, qx, qy, qz, qw", *rows])
    write_text(
        root / "imu.csv",
        ["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", "1000.5, 0, 0, 9.8, 0, 0, 0"],
    )
    return root


def stray_video(root: Path, takes: Any) -> Path:
    return stray(root, takes, colour=False)


def polycam(root: Path, takes: Any, corrected: bool = False) -> Path:
    """Polycam's raw export: keyframes/ with a camera of OpenGL axes for each image."""
    folder = root / "keyframes"
    write_images(folder, takes, "images/{:d}000.jpg", "depth/{:d}000.png")
    names = camera_names(takes)
    for i, T in enumerate(poses(takes)):
        pose = T @ GL
        values = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        values |= names | {"cx": names["cx"] + 0.5, "cy": names["cy"] + 0.5}
        values |= {
            "width": takes.camera.width,
            "height": takes.camera.height,
            "timestamp": 1000 * i,
        }
        values |= {"blur_score": 130.0, "manual_keyframe": False, "neighbors": []}
        takes.write(folder / f"cameras/{i}000.json", json.dumps(values).encode())
        confident = np.full(takes.depth_m[i].shape, 255, np.uint8)
        takes.write(folder / f"confidence/{i}000.png", cv2.imencode(".png", confident)[1].tobytes())
        if corrected:
            takes.write(folder / f"corrected_images/{i}000.jpg", takes.jpeg(i))
            takes.write(folder / f"corrected_cameras/{i}000.json", json.dumps(values).encode())
            drifted = values | {"t_03": values["t_03"] + 1.0}
            takes.write(folder / f"cameras/{i}000.json", json.dumps(drifted).encode())
    (root / "mesh_info.json").write_text("{}")
    return root


def polycam_corrected(root: Path, takes: Any) -> Path:
    return polycam(root, takes, corrected=True)


def scanner_app(root: Path, takes: Any) -> Path:
    """3D Scanner App, all data: a JSON for each frame, a colour image for some."""
    K = matrix(takes)
    K[:2, 2] += 0.5
    for i, T in enumerate(poses(takes)):
        values = {"intrinsics": K.ravel().tolist(), "cameraPoseARFrame": (T @ GL).ravel().tolist()}
        values |= {"time": 98064.68 + 0.1 * i, "frame_index": 6 * i, "motionQuality": 1}
        takes.write(root / f"frame_{6 * i:05d}.json", json.dumps(values).encode())
        takes.write(root / f"frame_{6 * i:05d}.jpg", takes.jpeg(i))
        for number in (6 * i, 6 * i + 1):
            takes.write(root / f"depth_{number:05d}.png", takes.depth_png(i))
            confident = np.full(takes.depth_m[i].shape, 2, np.uint8)
            takes.write(
                root / f"conf_{number:05d}.png", cv2.imencode(".png", confident)[1].tobytes()
            )
    (root / "info.json").write_text("{}")
    return root


def scannetpp_iphone(root: Path, takes: Any) -> Path:
    """ScanNet++'s iphone/: pose_intrinsic_imu.json."""
    write_images(root, takes, "rgb/frame_{:06d}.jpg", "depth/frame_{:06d}.png")
    K = matrix(takes).tolist()
    values = {
        f"frame_{i:06d}": {"poses": T.tolist(), "aligned_poses": T.tolist(), "intrinsic": K}
        for i, T in enumerate(poses(takes))
    }
    (root / "pose_intrinsic_imu.json").write_text(json.dumps(values))
    return root


def record3d(root: Path, takes: Any) -> Path:
    """Record3D's .r3d: an archive with the metadata, and for each frame a JPEG, depth in metres and
    confidences, as LZFSE blocks that are not packed."""
    import struct
    import zipfile

    def lzfse(data: bytes) -> bytes:
        return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"

    c = takes.camera
    rows = []
    for T in poses(takes):
        x, y, z, *quaternion = row_of(T @ GL)
        rows.append([*quaternion, x, y, z])
    metadata = {"w": c.width, "h": c.height, "dw": c.width, "dh": c.height, "fps": 60}
    metadata |= {"K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "poses": rows}
    metadata |= {"frameTimestamps": [1000.5 + t for t in range(len(takes))]}
    root.mkdir(parents=True, exist_ok=True)
    file = root / "2023-05-01--10-00-00.r3d"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for i in range(len(takes)):
            depth = takes.depth_m[i].astype("<f4")
            archive.writestr(f"rgbd/{i}.jpg", takes.jpeg(i))
            archive.writestr(f"rgbd/{i}.depth", lzfse(depth.tobytes()))
            confident = np.full(depth.shape, 2, np.uint8)
            archive.writestr(f"rgbd/{i}.conf", lzfse(confident.tobytes()))
    return file


def arkitscenes(root: Path, takes: Any) -> Path:
    """lowres_wide, lowres_depth, a .pincam for each image and a .traj: time, axis times angle,
    translation."""
    from scipy.spatial.transform import Rotation

    folder = write_images(
        root / "41048190",
        takes,
        "lowres_wide/41048190_{t:.3f}.png",
        "lowres_depth/41048190_{t:.3f}.png",
    )
    c = takes.camera
    for t in takes.times_s:
        text = " ".join(map(str, (c.width, c.height, *camera_names(takes).values())))
        takes.write(folder / f"lowres_wide_intrinsics/41048190_{t:.3f}.pincam", text.encode())
    rows = []
    for t, T in zip(takes.times_s, poses(takes), strict=True):
        T_CW = np.linalg.inv(T)
        axis = Rotation.from_matrix(T_CW[:3, :3]).as_rotvec()
        rows.append(f"{t:.6f} {words(axis)} {words(T_CW[:3, 3])}")
    write_text(folder / "lowres_wide.traj", rows)
    return folder


# ---- Programs of cameras -------------------------------------------------------------------------


def azure_open3d(root: Path, takes: Any) -> Path:
    """What Open3D's azure_kinect_mkv_reader writes: intrinsic.json has the matrix column by
    column."""
    write_images(root, takes, "color/{:05d}.jpg", "depth/{:05d}.png")
    c = takes.camera
    values = {
        "color_mode": "MJPG_720P",
        "depth_mode": "NFOV_UNBINNED",
        "height": c.height,
        "width": c.width,
    }
    values |= {
        "intrinsic_matrix": matrix(takes).T.ravel().tolist(),
        "serial_number_": "0",
        "stream_length_usec": 9,
    }
    (root / "intrinsic.json").write_text(json.dumps(values))
    return root


def k4a_calibration(root: Path, takes: Any) -> Path:
    """The raw calibration of an Azure Kinect beside its images."""
    write_images(root, takes, "color/{:05d}.jpg", "depth/{:05d}.png")
    lens = {
        "ModelParameters": [0.5, 0.5, 0.6, 0.8, *[0.0] * 10],
        "ModelParameterCount": 14,
        "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
    }
    cameras = [
        {"Intrinsics": lens, "Purpose": f"CALIBRATION_Camera{kind}", "SensorWidth": 4096}
        for kind in ("Depth", "PhotoVideo")
    ]
    (root / "calibration.json").write_text(
        json.dumps({"CalibrationInformation": {"Cameras": cameras}})
    )
    return root


def rtabmap_database(root: Path, takes: Any) -> Path:
    root.mkdir(parents=True)
    with sqlite3.connect(root / "map.db") as database:
        database.execute("CREATE TABLE Node (id INTEGER)")
        database.execute("CREATE TABLE Data (id INTEGER)")
    database.close()
    return root / "map.db"


def rtabmap_calibration(takes: Any) -> str:
    """As OpenCV writes it; local_transform turns the axes of the robot's base to those of the
    camera."""
    c = takes.camera
    values = {"camera_matrix": matrix(takes), "distortion_coefficients": np.zeros((1, 5))}
    values |= {"local_transform": np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]])}
    lines = [
        "%YAML:1.0",
        "---",
        f"image_width: {c.width}",
        f"image_height: {c.height}",
        "distortion_model: plumb_bob",
    ]
    for name, value in values.items():
        rows, columns = value.shape
        data = ", ".join(f"{v:.9f}" for v in value.ravel())
        lines += [f"{name}:", f"   rows: {rows}", f"   cols: {columns}", f"   data: [ {data} ]"]
    return "\n".join([*lines, ""])


def rtabmap_export(root: Path, takes: Any, poses_of: str = "camera_poses") -> Path:
    """rtabmap-export --images_id --poses_camera: names are node numbers with gaps, poses have them
    behind."""
    numbers = [1, 4, 5, 9]
    for i, number in enumerate(numbers):
        takes.write(root / f"rtabmap_rgb/{number}.jpg", takes.jpeg(i))
        takes.write(root / f"rtabmap_depth/{number}.png", takes.depth_png(i))
        takes.write(root / f"rtabmap_calib/{number}.yaml", rtabmap_calibration(takes).encode())
    rows = [f"{t:.6f} {words(takes.tum_row(i))} {numbers[i]}" for i, t in enumerate(takes.times_s)]
    write_text(root / f"rtabmap_{poses_of}.txt", ["#timestamp x y z qx qy qz qw id", *rows])
    return root


def rtabmap_base_poses(root: Path, takes: Any) -> Path:
    """rtabmap-export --poses: poses of the robot, not of its camera."""
    return rtabmap_export(root, takes, "poses")


def zed_export(root: Path, takes: Any) -> Path:
    """ZED's SVO export: left000000.png and depth000000.png in millimetres."""
    return write_images(root, takes, "left{:06d}.png", "depth{:06d}.png")


def zed_calibration(root: Path, takes: Any) -> Path:
    """The factory calibration of a ZED, with a section for each camera and resolution."""
    zed_export(root, takes)
    sections = [
        f"[{side}_CAM_{size}]\n" + "\n".join(f"{k}={v:.6f}" for k, v in camera_names(takes).items())
        for side in ("LEFT", "RIGHT")
        for size in ("2K", "HD")
    ]
    write_text(root / "SN12345.conf", sections)
    return root


def realsense_convert(root: Path, takes: Any) -> Path:
    """rs-convert -p: all images in one folder, names end in the milliseconds of the frame."""
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"_Color_{1000 * t:.5f}.png", takes.png(i))
        takes.write(root / f"_Depth_{1000 * t:.5f}.png", takes.depth_png(i))
    return root


def oak_calibration(root: Path, takes: Any) -> Path:
    """DepthAI's calib.json: cameras by socket, 0 is colour."""
    write_images(root, takes, "color/{:06d}.png", "depth/{:06d}.png")
    c = takes.camera
    camera = {"cameraType": 0, "distortionCoeff": [0.0] * 14, "height": c.height, "width": c.width}
    colour = camera | {"intrinsicMatrix": matrix(takes).tolist()}
    grey = camera | {"intrinsicMatrix": (matrix(takes) * [[2], [2], [1]]).tolist()}
    (root / "calib.json").write_text(
        json.dumps({"boardName": "DM9098", "cameraData": [[2, grey], [0, colour]]})
    )
    return root


def airsim(root: Path, takes: Any) -> Path:
    """AirSim: images/img_*.pfm of depth in metres, airsim_rec.txt."""
    for i in range(len(takes)):
        takes.write(root / f"images/img_{i}_rgb.png", takes.png(i))
        takes.write(
            root / f"images/img_{i}_depth.pfm", cv2.imencode(".pfm", takes.depth_m[i])[1].tobytes()
        )
    header = "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile"
    rows = [
        f"\t{i}\t0\t0\t0\t1\t0\t0\t0\timg_{i}_rgb.png;img_{i}_depth.pfm" for i in range(len(takes))
    ]
    write_text(root / "airsim_rec.txt", [header, *rows])
    return root


# ---- Data sets -----------------------------------------------------------------------------------


def scannet_exported(root: Path, takes: Any, extrinsic: np.ndarray | None = None) -> Path:
    """The exporter's folders; the second pose is lost."""
    write_images(root, takes, "color/{}.jpg", "depth/{}.png")
    for i, T in enumerate(poses(takes)):
        write_text(
            root / f"pose/{i}.txt",
            [words(row) for row in (np.full((4, 4), -np.inf) if i == 1 else T)],
        )
    for kind in ("color", "depth"):
        write_text(
            root / f"intrinsic/intrinsic_{kind}.txt", [words(row) for row in matrix(takes, 4)]
        )
        of_kind = np.eye(4) if kind == "color" or extrinsic is None else extrinsic
        write_text(root / f"intrinsic/extrinsic_{kind}.txt", [words(row) for row in of_kind])
    return root


def scannet_extrinsic(root: Path, takes: Any) -> Path:
    """A depth camera beside the colour camera, as the file says."""
    return scannet_exported(root, takes, T_RIG_DEPTH)


def scannet_25k(root: Path, takes: Any) -> Path:
    """scannet_frames_25k: intrinsics_color.txt and intrinsics_depth.txt of images of two sizes."""
    write_images(root, takes, "color/{:06d}.jpg", "depth/{:06d}.png")
    for i, T in enumerate(poses(takes)):
        write_text(root / f"pose/{i:06d}.txt", [words(row) for row in T])
    write_text(root / "intrinsics_color.txt", [words(row) for row in matrix(takes, 4)])
    shorter = matrix(takes, 4)
    shorter[[0, 1], [0, 1]] *= 0.9
    write_text(root / "intrinsics_depth.txt", [words(row) for row in shorter])
    return root


def three_d_match(root: Path, takes: Any) -> Path:
    """3DMatch: names of 7-Scenes, the calibration beside the sequence, 65535 where depth is
    missing."""
    folder = root / "7-scenes-redkitchen"
    for i, T in enumerate(poses(takes)):
        stored = takes.depth_raw(i)
        stored[:4, :5] = 65535
        takes.write(folder / f"seq-01/frame-{i:06d}.color.png", takes.png(i))
        takes.write(
            folder / f"seq-01/frame-{i:06d}.depth.png", cv2.imencode(".png", stored)[1].tobytes()
        )
        write_text(
            folder / f"seq-01/frame-{i:06d}.pose.txt",
            ["\t".join(f"{v:.9e}" for v in row) + "\t" for row in T],
        )
    write_text(
        folder / "camera-intrinsics.txt",
        ["\t".join(f"{v:.6f}" for v in row) for row in matrix(takes)],
    )
    return folder


def bundlefusion(root: Path, takes: Any, depth_shift: float = 5000.0) -> Path:
    """BundleFusion's frames with info.txt, which holds the unit of depth."""
    for i, T in enumerate(poses(takes)):
        takes.write(root / f"frame-{i:06d}.color.jpg", takes.jpeg(i))
        takes.write(root / f"frame-{i:06d}.depth.png", takes.depth_png(i, depth_shift))
        write_text(root / f"frame-{i:06d}.pose.txt", [words(row) for row in T])
    c = takes.camera
    lines = ["m_versionNumber = 4", "m_sensorName = StructureSensor"]
    for kind in ("color", "depth"):
        lines += [f"m_{kind}Width = {c.width}", f"m_{kind}Height = {c.height}"]
    lines += [f"m_depthShift = {depth_shift:g}"]
    for kind in ("Color", "Depth"):
        lines += [f"m_calibration{kind}Intrinsic = {words(matrix(takes, 4))}"]
        lines += [f"m_calibration{kind}Extrinsic = {words(np.eye(4))}"]
    write_text(root / "info.txt", [*lines, "m_frames.size = 4"])
    return root


def sun3d(root: Path, takes: Any) -> Path:
    """SUN3D: the bits of depth are turned by 3, poses are three rows for each colour image."""
    for i in range(len(takes)):
        millimetres = takes.depth_raw(i)
        turned = ((millimetres << 3) | (millimetres >> 13)).astype(np.uint16)
        takes.write(root / f"image/{i + 1:07d}-{33369 * i:012d}.jpg", takes.jpeg(i))
        takes.write(
            root / f"depth/{i + 1:07d}-{33369 * i + 400:012d}.png",
            cv2.imencode(".png", turned)[1].tobytes(),
        )
    write_text(root / "intrinsics.txt", [words(row) for row in matrix(takes)])
    rows = [words(row) for T in poses(takes) for row in T[:3]]
    write_text(root / "extrinsics/20140808220511.txt", rows)
    write_text(
        root / "extrinsics/20130512130736.txt", ["1 0 0 0", "0 1 0 0", "0 0 1 0"] * len(takes)
    )
    return root


def redwood(root: Path, takes: Any) -> Path:
    """Redwood's scans: numbers and times in the names, the trajectory as a .log."""
    for i in range(len(takes)):
        takes.write(root / f"rgb/{i + 1:07d}-{33369 * i:012d}.jpg", takes.jpeg(i))
        takes.write(root / f"depth/{i + 1:07d}-{33369 * i:012d}.png", takes.depth_png(i))
    lines = [
        line
        for i, T in enumerate(poses(takes))
        for line in (f"{i} {i} {i + 1}", *(words(row) for row in T))
    ]
    write_text(root / "trajectory.log", lines)
    return root


def eth3d(root: Path, takes: Any) -> Path:
    """ETH3D SLAM: TUM's lists, associated.txt and calibration.txt of four numbers."""
    tum_lists(root, takes)
    write_text(
        root / "calibration.txt",
        [" ".join(map(str, camera_names(takes).values()))],
    )
    write_text(
        root / "associated.txt",
        [f"{t:.6f} rgb/{t:.6f}.png {t:.6f} depth/{t:.6f}.png" for t in takes.times_s],
    )
    return root


def bonn(root: Path, takes: Any) -> Path:
    """Bonn's dynamic data set: TUM's lists of another camera."""
    return tum_lists(root / "rgbd_bonn_balloon", takes)


def corbs(root: Path, takes: Any) -> Path:
    """CoRBS: TUM's lists of a Kinect 2, ground truth with the name of the sequence."""
    folder = tum_lists(root / "H1_pre_registereddata", takes)
    (folder / "groundtruth.txt").rename(folder / "groundtruth_H1.txt")
    return folder


def neural_rgbd(root: Path, takes: Any) -> Path:
    """Neural RGB-D: one focal length, OpenGL axes, NaN where there is no pose."""
    write_images(root, takes, "images/img{}.png", "depth/depth{}.png")
    c = takes.camera
    rows = [
        words(row)
        for i, T in enumerate(poses(takes))
        for row in (T @ GL if i != 2 else np.full((4, 4), np.nan))
    ]
    write_text(root / "poses.txt", rows)
    write_text(root / "trainval_poses.txt", rows)
    write_text(root / "focal.txt", [f"{c.fx:.9f}"])
    return root


def tartanair(root: Path, takes: Any) -> Path:
    """TartanAir: depth as NumPy in metres with a sky, poses in AirSim's axes."""
    for i in range(len(takes)):
        takes.write(root / f"image_left/{i:06d}_left.png", takes.png(i))
        (root / "depth_left").mkdir(exist_ok=True)
        stored = takes.depth_m[i].astype(np.float32)
        np.save(root / f"depth_left/{i:06d}_left_depth.npy", stored)
    write_text(
        root / "pose_left.txt",
        [words(row_of(NED @ T @ NED.T)) for T in poses(takes)],
    )
    return root


def tartanair_2(root: Path, takes: Any) -> Path:
    """TartanAir V2: depth as float32 in the four channels of a PNG."""
    for i in range(len(takes)):
        takes.write(root / f"image_lcam_front/{i:06d}_lcam_front.png", takes.png(i))
        packed = takes.depth_m[i].astype("<f4")[..., None].view(np.uint8)
        takes.write(
            root / f"depth_lcam_front/{i:06d}_lcam_front_depth.png",
            cv2.imencode(".png", packed)[1].tobytes(),
        )
    write_text(
        root / "pose_lcam_front.txt",
        [words(row_of(NED @ T @ NED.T)) for T in poses(takes)],
    )
    return root


def bop(root: Path, takes: Any) -> Path:
    """BOP (T-LESS, YCB-V): scene_camera.json, depth in tenths of a millimetre, poses
    world-to-camera in millimetres."""
    write_images(root / "000001", takes, "rgb/{:06d}.png", "depth/{:06d}.png", 10_000)
    values = {}
    for i, T in enumerate(poses(takes)):
        T_CW = np.linalg.inv(T)
        entry = {"cam_K": matrix(takes).ravel().tolist(), "depth_scale": 0.1}
        values[str(i)] = entry | {
            "cam_R_w2c": T_CW[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * T_CW[:3, 3]).tolist(),
        }
    (root / "000001/scene_camera.json").write_text(json.dumps(values))
    return root / "000001"


def semantic_nerf(root: Path, takes: Any) -> Path:
    """Replica of Semantic-NeRF and iMAP: traj_w_c.txt."""
    write_images(root, takes, "rgb/rgb_{}.png", "depth/depth_{}.png")
    write_text(root / "traj_w_c.txt", [words(T) for T in poses(takes)])
    return root


def nice_slam(root: Path, takes: Any) -> Path:
    """Folders as Replica's with cam_params.json, whose scale is the unit of depth, but names of
    their own."""
    write_images(root, takes, "color/{}.png", "depth/{}.png", 6553.5)
    c = takes.camera
    names = camera_names(takes)
    (root / "cam_params.json").write_text(
        json.dumps({"camera": {"w": c.width, "h": c.height, **names, "scale": 6553.5}})
    )
    write_text(root / "traj.txt", [words(T) for T in poses(takes)])
    return root


def nyu_raw(root: Path, takes: Any) -> Path:
    """NYU Depth V2, raw: disparity with its bytes swapped, in a dump of another clock."""
    for i, t in enumerate(takes.times_s):
        takes.write(
            root / f"r-{t:.6f}-{1000 + i}.ppm", cv2.imencode(".ppm", takes.rgb[i])[1].tobytes()
        )
        takes.write(
            root / f"d-{t:.6f}-{1500 + i}.pgm",
            cv2.imencode(".pgm", takes.depth_raw(i).byteswap())[1].tobytes(),
        )
        takes.write(root / f"a-{t:.6f}-{1700 + i}.dump", b"\0")
    return root


def euroc(root: Path, takes: Any) -> Path:
    """EuRoC and TUM-VI: two grey cameras, no depth."""
    for cam in ("cam0", "cam1"):
        for i, t in enumerate(takes.times_s):
            takes.write(root / f"mav0/{cam}/data/{int(1e9 * t)}.png", takes.png(i))
        write_text(
            root / f"mav0/{cam}/data.csv",
            [
                "#timestamp [ns],filename",
                *(f"{int(1e9 * t)},{int(1e9 * t)}.png" for t in takes.times_s),
            ],
        )
    return root


def hypersim(root: Path, takes: Any) -> Path:
    """Hypersim: distances from the camera as HDF5."""
    for i in range(len(takes)):
        takes.write(
            root / f"images/scene_cam_00_final_preview/frame.{i:04d}.tonemap.jpg", takes.jpeg(i)
        )
        takes.write(
            root / f"images/scene_cam_00_geometry_hdf5/frame.{i:04d}.depth_meters.hdf5",
            b"\x89HDF\r\n\x1a\n",
        )
    return root


def matterport(root: Path, takes: Any) -> Path:
    """Matterport3D: depth in quarters of a millimetre."""
    for i in range(len(takes)):
        takes.write(root / f"matterport_color_images/0f37_i0_{i}.jpg", takes.jpeg(i))
        takes.write(root / f"matterport_depth_images/0f37_d0_{i}.png", takes.depth_png(i, 4000))
    return root


def colmap(root: Path, takes: Any, second_line: str = "") -> Path:
    """A COLMAP model as text: two cameras of several models, numbers with gaps, images in another
    order."""
    write_images(root, takes, "images/{:04d}.png", "depth/{:04d}.png")
    c = takes.camera
    cameras = [
        f"3 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}",
        f"7 OPENCV {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy} 0 0 0 0",
    ]
    write_text(
        root / "sparse/0/cameras.txt", ["# Camera list with one line of data per camera:", *cameras]
    )
    lines = ["# Image list with two lines of data per image:"]
    for i in (2, 0, 3, 1):
        x, y, z, qx, qy, qz, qw = row_of(np.linalg.inv(poses(takes)[i]))
        lines += [
            f"{11 + 5 * i} {words([qw, qx, qy, qz, x, y, z])} {(3, 7)[i % 2]} {i:04d}.png",
            second_line,
        ]
    write_text(root / "sparse/0/images.txt", lines)
    write_text(root / "sparse/0/points3D.txt", ["# 3D point list with one line of data per point:"])
    return root


def colmap_own_depth(root: Path, takes: Any) -> Path:
    """COLMAP's dense workspace: its own depth maps have no unit."""
    colmap(root, takes)
    for file in (root / "depth").iterdir():
        file.unlink()
    (root / "depth").rmdir()
    for i in range(len(takes)):
        data = b"60&44&1&" + takes.depth_m[i].astype("<f4").tobytes()
        takes.write(root / f"stereo/depth_maps/{i:04d}.png.geometric.bin", data)
    return root


def nerfstudio(root: Path, takes: Any, **extra: Any) -> Path:
    """transforms.json: OpenGL axes, depth in tenths of a millimetre, a moved and scaled world."""
    write_images(root, takes, "images/frame_{:05d}.png", "depth/frame_{:05d}.png", 10_000)
    c = takes.camera
    A = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1]])
    scaled = np.diag([0.5, 0.5, 0.5, 1.0])
    frames = []
    for i, T in enumerate(poses(takes)):
        moved = np.vstack([A, [0, 0, 0, 1]]) @ T @ GL
        moved[:3, 3] = (scaled @ moved)[:3, 3]
        frame = {
            "file_path": f"images/frame_{i:05d}.png",
            "depth_file_path": f"depth/frame_{i:05d}.png",
        }
        frames.append(frame | {"transform_matrix": moved.tolist(), "mask_path": f"masks/{i}.png"})
    values = {
        "w": c.width,
        "h": c.height,
        "fl_x": c.fx,
        "fl_y": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "camera_model": "OPENCV",
    }
    values |= {
        "depth_unit_scale_factor": 1e-4,
        "applied_transform": A.tolist(),
        "applied_scale": 0.5,
        "frames": frames,
    }
    (root / "transforms.json").write_text(json.dumps(values | extra))
    return root


def nerfstudio_crop(root: Path, takes: Any) -> Path:
    return nerfstudio(root, takes, camera_model="OPENCV_FISHEYE", fisheye_crop_radius=700.0)


def nerfstudio_ray(root: Path, takes: Any) -> Path:
    """Depth as the distance from the camera's centre, as renderers write it."""
    nerfstudio(root, takes, depth_type="ray")
    c = takes.camera
    u, v = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
    per_z = np.sqrt(1 + ((u - c.cx) / c.fx) ** 2 + ((v - c.cy) / c.fy) ** 2)
    for i in range(len(takes)):
        stored = np.rint(takes.depth_m[i] * per_z * 10_000).astype(np.uint16)
        file = root / f"depth/frame_{i:05d}.png"
        file.write_bytes(cv2.imencode(".png", stored)[1].tobytes())
    return root


def nerfstudio_relative(root: Path, takes: Any) -> Path:
    return nerfstudio(root, takes, depth_type="relative")


def named_poses(root: Path, takes: Any) -> Path:
    """A list of poses that names the images, not their times, in another order, w first."""
    write_images(root, takes, "color/view_{:02d}.png", "depth/view_{:02d}.png")
    rows = []
    for i in reversed(range(len(takes))):
        *place, x, y, z, w = takes.tum_row(i)
        rows.append(f"view_{i:02d}.png,{','.join(map(str, (*place, w, x, y, z)))}")
    write_text(root / "poses.csv", ["name,tx,ty,tz,qw,qx,qy,qz", *rows])
    return root


def poses_without_header(root: Path, takes: Any) -> Path:
    """Lists of TUM, whose poses have lost the comment that names their columns."""
    tum_lists(root, takes)
    rows = (root / "groundtruth.txt").read_text().splitlines()[1:]
    write_text(root / "groundtruth.txt", rows)
    return root


def scaled_calibration(root: Path, takes: Any) -> Path:
    """A calibration that says that the images were made smaller, and not which ones it holds
    for."""
    write_images(root, takes, "color/{:d}.png", "depth/{:d}.png")
    (root / "calibration.json").write_text(json.dumps(camera_names(takes) | {"scale": 0.5}))
    return root


def turned_calibration(root: Path, takes: Any) -> Path:
    write_images(root, takes, "color/{:d}.png", "depth/{:d}.png")
    (root / "calibration.json").write_text(json.dumps(camera_names(takes) | {"rotation": 90}))
    return root


def realsense_db3(root: Path, takes: Any) -> Path:
    """A recording of librealsense 2.58 and newer: a ROS 2 database without metadata.yaml."""
    root.mkdir(parents=True)
    with sqlite3.connect(root / "20260330.db3") as database:
        database.execute(
            "CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)"
        )
        database.execute(
            "CREATE TABLE messages (id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute(
            "INSERT INTO topics VALUES (1, '/device_0/sensor_0/Depth_0/image/data', "
            "'sensor_msgs/msg/Image', 'cdr')"
        )
    database.close()
    return root / "20260330.db3"


def file_of(name: str, begin: bytes = b"\0" * 64):
    """A maker of one file of a program whose recordings are not read."""

    def make(root: Path, takes: Any) -> Path:
        return takes.write(root / name, begin)

    return make
