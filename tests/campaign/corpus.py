"""Small valid files of every kind that the toolkit reads, and files made to harm."""

import dataclasses
import gzip
import importlib.util
import io
import itertools
import json
import struct
import sys
import tarfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import torch

from gsfusion_nb.export import write_gaussian_ply, write_mesh_ply, write_trajectory_tum
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.runs.checkpoint import save_checkpoint
from gsfusion_nb.types import Camera, GaussianParams, Mesh

TESTS = Path(__file__).resolve().parents[1]
PLUGINS = TESTS / "plugins"
GL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
BOMB_BYTES = 1_200_000_000


@dataclass(frozen=True)
class Seed:
    """One valid input."""

    name: str
    target: str
    """How it is read: a name in ``targets.TARGETS``."""
    root: Path
    entry: str = ""
    """What is opened, below ``root``; the folder itself by default."""
    beside: tuple[str, ...] = ()
    """Patterns of files that are rightly not read, such as poses that later ones replace."""


def of_tests(path: str) -> ModuleType:
    """A module of the test suite, whose writers of foreign formats are used here."""
    name = "campaign_" + path.replace("/", "_").removesuffix(".py")
    if name not in sys.modules:
        if str(PLUGINS) not in sys.path:  # as pytest's setting ``pythonpath`` has it
            sys.path.append(str(PLUGINS))
        spec = importlib.util.spec_from_file_location(name, TESTS / path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


def make_takes(n: int = 4):
    """Frames of the box-shaped room, 24x18."""
    box = of_tests("plugins/box_room.py").Box()
    camera = Camera(
        width=24,
        height=18,
        fx=22.0,
        fy=21.0,
        cx=11.7,
        cy=9.2,
    )
    poses = box.poses(n)
    poses[:, :3, :3] = quaternion.to_matrix(quaternion.from_matrix(poses[:, :3, :3]))
    views = [box.render(T, camera) for T in poses]
    rgb = [v[0] for v in views]
    depth_m = [v[1].astype(np.float32) for v in views]
    times_s = [1.7e9 + 0.2 * i for i in range(n)]
    return of_tests("recordings/convert/conftest.py").Takes(camera, rgb, depth_m, poses, times_s)


def build(root: Path) -> list[Seed]:
    """Write the valid files below ``root``."""
    takes = make_takes()
    seeds = [
        *_layouts(root, takes),
        *_formats(root, takes),
        *_single_files(root, takes),
        *_run_folder(root, takes),
    ]
    for seed in seeds:
        assert (seed.root / seed.entry).exists(), seed
    return seeds


def _layouts(root: Path, takes) -> list[Seed]:
    c = takes.camera
    lines = [" ".join(map(repr, T.flatten().tolist())) for T in takes.T_WC]
    intrinsics = {
        **vars(c),
        "cx": c.cx - 0.5,
        "cy": c.cy - 0.5,
        "depth_scale": 1000.0,
        "fps": 10,
        "pixel_centre": 0.0,
    }
    folder, replica, seven, tum = (
        root / n for n in ("folder", "replica", "seven", "rgbd_dataset_freiburg3_x")
    )
    spp = root / "scannetpp"
    frames = []
    for i in range(len(takes)):
        takes.write(folder / f"rgb/{i:06d}.png", takes.png(i))
        takes.write(folder / f"depth/{i:06d}.png", takes.depth_png(i))
        takes.write(replica / f"results/frame{i:06d}.jpg", takes.jpeg(i))
        takes.write(replica / f"results/depth{i:06d}.png", takes.depth_png(i, 6553.5))
        takes.write(seven / f"frame-{i:06d}.color.png", takes.png(i))
        takes.write(seven / f"frame-{i:06d}.depth.png", takes.depth_png(i))
        rows = "\n".join(" ".join(map(repr, row)) for row in takes.T_WC[i].tolist())
        takes.write(seven / f"frame-{i:06d}.pose.txt", rows.encode())
        takes.write(spp / f"dslr/undistorted_images/D{i}.JPG", takes.jpeg(i))
        takes.write(spp / f"dslr/undistorted_depths/D{i}.png", takes.depth_png(i))
        frames.append({"file_path": f"D{i}.JPG", "transform_matrix": (takes.T_WC[i] @ GL).tolist()})
    takes.write(folder / "poses.txt", "\n".join(lines).encode())
    takes.write(folder / "intrinsics.json", json.dumps(intrinsics).encode())
    takes.write(replica / "traj.txt", "\n".join(lines).encode())
    keys = {
        "w": c.width,
        "h": c.height,
        "fx": c.fx,
        "fy": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "scale": 6553.5,
    }
    takes.write(replica / "cam_params.json", json.dumps({"camera": keys}).encode())
    values = {
        "w": c.width,
        "h": c.height,
        "fl_x": c.fx,
        "fl_y": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "frames": frames[:3],
    }
    values |= {"camera_model": "PINHOLE", "test_frames": frames[3:]}
    takes.write(spp / "dslr/nerfstudio/transforms_undistorted.json", json.dumps(values).encode())
    lists = {"train": ["D0.JPG", "D2.JPG", "D1.JPG"], "test": ["D3.JPG"]}
    takes.write(spp / "dslr/train_test_lists.json", json.dumps(lists).encode())
    _write_tum(tum, takes)
    seeds = [Seed(p.name, "sequence", p) for p in (folder, replica, seven, spp, tum)]
    return [*seeds, Seed("growing", "growing", folder)]


def _write_tum(root: Path, takes, intrinsics: str = "") -> Path:
    """Lists, and images of the benchmark's size unless the intrinsics are given."""
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"rgb/{t}.png", takes.png(i))
        takes.write(root / f"depth/{t}.png", takes.depth_png(i, 5000))
    for kind in ("rgb", "depth"):
        takes.write(
            root / f"{kind}.txt", "\n".join(f"{t} {kind}/{t}.png" for t in takes.times_s).encode()
        )
    rows = [" ".join(map(repr, [t, *takes.tum_row(i)])) for i, t in enumerate(takes.times_s)]
    takes.write(
        root / "groundtruth.txt", "\n".join(["# timestamp tx ty tz qx qy qz qw", *rows]).encode()
    )
    if intrinsics:
        takes.write(root / "calibration.txt", intrinsics.encode())
    return root


def _formats(root: Path, takes) -> list[Seed]:
    c = takes.camera
    K = f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}"
    seeds = [Seed("tum_style", "convert", _write_tum(root / "tum_style", takes, K))]
    colmap = of_tests("recordings/convert/formats/test_colmap.py")
    for suffix in (".txt", ".bin"):
        made = colmap.write_colmap(root / f"colmap{suffix[1:]}", takes, suffix)
        seeds.append(Seed(made.name, "convert", made))
    scannet = of_tests("recordings/convert/formats/test_scannet.py")
    seeds.append(
        Seed("sens", "convert", scannet.write_sens(root / "sens/a.sens", takes).parent, "a.sens")
    )
    seeds.append(Seed("scannet", "convert", scannet.write_exported(root / "scannet", takes)))
    record3d = of_tests("recordings/convert/formats/test_record3d.py")
    (root / "r3d").mkdir()
    seeds.append(
        Seed(
            "r3d",
            "convert",
            record3d.write_r3d(root / "r3d/a.r3d", record3d.members(takes)).parent,
            "a.r3d",
        )
    )
    for name, data in record3d.members(takes).items():
        takes.write(root / "r3d_folder" / name, data)
    seeds.append(Seed("r3d_folder", "convert", root / "r3d_folder"))
    seeds += [
        _nerfstudio(root, takes),
        *_open3d(root, takes),
        _icl(root, takes),
        *_bags(root, takes),
    ]
    return [*seeds, *_kinds(root, takes)]


_KINDS = (
    "stray",
    "polycam_corrected",
    "scanner_app",
    "rtabmap_export",
    "scannet_25k",
    "bundlefusion",
    "sun3d",
    "neural_rgbd",
    "tartanair",
    "tartanair_2",
    "bop",
    "nice_slam",
    "oak_calibration",
)
"""Recordings of apps and data sets that the tests of kinds write."""


_BESIDE = {
    "polycam_corrected": ("cameras/*.json", "mesh_info.json"),
    "scanner_app": ("info.json",),
}
"""Kind -> files of it that no reader needs; a damage in them changes nothing."""


def _kinds(root: Path, takes) -> list[Seed]:
    makers = of_tests("plugins/recorded_kinds.py")
    seeds = []
    for name in _KINDS:
        folder = root / f"kind_{name}"
        made = getattr(makers, name)(folder, takes)
        seeds.append(
            Seed(
                folder.name,
                "convert",
                folder,
                made.relative_to(folder).as_posix(),
                beside=_BESIDE.get(name, ()),
            )
        )
    return seeds


def _bags(root: Path, takes) -> list[Seed]:
    ros = of_tests("recordings/convert/formats/test_ros_bag.py")
    (root / "bag1").mkdir()
    ros.write_bag(root / "bag1/a.bag", takes, 1)
    ros.write_bag(root / "bag2", takes, 2, poses="pose", colour="jpeg")
    (root / "mcap").mkdir()
    ros.write_bag(
        root / "mcap/m", takes, 2, storage=ros.StoragePlugin.MCAP, colour="png", depth="png"
    )
    (file,) = (root / "mcap/m").glob("*.mcap")
    file.rename(root / "mcap/a.mcap")
    for left in (root / "mcap/m").iterdir():
        left.unlink()
    (root / "mcap/m").rmdir()
    return [
        Seed("bag1", "convert", root / "bag1", "a.bag"),
        Seed("bag2", "convert", root / "bag2"),
        Seed("mcap", "convert", root / "mcap", "a.mcap"),
    ]


def _nerfstudio(root: Path, takes) -> Seed:
    c = takes.camera
    at = root / "nerfstudio"
    frames = []
    for i in range(len(takes)):
        takes.write(at / f"images/{i}.png", takes.png(i))
        out = io.BytesIO()
        np.save(out, takes.depth_m[i])
        takes.write(at / f"depth/{i}.npy", out.getvalue())
        frame = {"file_path": f"images/{i}", "depth_file_path": f"depth/{i}.npy"}
        frames.append(
            frame | {"transform_matrix": (takes.T_WC[i] @ GL).tolist(), "timestamp": 5.0 + i}
        )
    values = {
        "w": c.width,
        "h": c.height,
        "fl_x": c.fx,
        "fl_y": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "k1": 0.01,
        "k2": 0.0,
    }
    values |= {
        "depth_unit_scale_factor": 1.0,
        "applied_scale": 1.0,
        "applied_transform": torch.eye(4)[:3].tolist(),
    }
    takes.write(at / "transforms.json", json.dumps(values | {"frames": frames}).encode())
    return Seed("nerfstudio", "convert", at)


def _open3d(root: Path, takes) -> list[Seed]:
    c = takes.camera
    seeds = []
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx - 0.5, c.cy - 0.5, 1]
    camera = {"width": c.width, "height": c.height, "intrinsic_matrix": K}
    for kind in ("log", "json"):
        at = root / f"open3d_{kind}"
        for i in range(len(takes)):
            takes.write(at / f"color/{i}.png", takes.png(i))
            takes.write(at / f"depth/{i}.png", takes.depth_png(i))
        rows = ["\n".join(" ".join(map(repr, r)) for r in T.tolist()) for T in takes.T_WC]
        log = "\n".join(f"{i} {i} {i + 1}\n{text}" for i, text in enumerate(rows))
        poses = [
            {"extrinsic": se3.inverse(T).T.flatten().tolist(), "intrinsic": camera}
            for T in takes.T_WC
        ]
        text = log if kind == "log" else json.dumps({"parameters": poses})
        takes.write(at / f"trajectory.{kind}", text.encode())
        if kind == "log":
            takes.write(at / "camera_intrinsic.json", json.dumps(camera).encode())
        seeds.append(Seed(at.name, "convert", at))
    return seeds


def _icl(root: Path, takes) -> Seed:
    at = root / "icl"
    for i in range(2):
        takes.write(
            at / f"rgb/{i}.png",
            cv2.imencode(".png", np.full((480, 640, 3), 90, np.uint8))[1].tobytes(),
        )
        takes.write(
            at / f"depth/{i}.png",
            cv2.imencode(".png", np.full((480, 640), 9000, np.uint16))[1].tobytes(),
        )
    rows = [" ".join(map(repr, [float(i), *takes.tum_row(i)])) for i in range(2)]
    takes.write(at / "x.gt.freiburg", "\n".join(rows).encode())
    return Seed("icl", "convert", at)


def _single_files(root: Path, takes) -> list[Seed]:
    c = takes.camera
    at = root / "files"
    at.mkdir()
    rows = [[t, *takes.tum_row(i)] for i, t in enumerate(takes.times_s)]
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y "
        "[], q_RS_z []"
    )
    euroc = [[round(r[0] * 1e9), *r[1:4], r[7], *r[4:7]] for r in rows]
    texts = {
        "tum.txt": "\n".join(" ".join(map(repr, r)) for r in rows),
        "euroc.csv": "\n".join([header, *(",".join(map(repr, r)) for r in euroc)]),
        "K.txt": f"[[{c.fx}, 0, {c.cx}],\n [0, {c.fy}, {c.cy}],\n [0, 0, 1]]",
        "K.json": json.dumps(
            {"width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
        ),
        "T.txt": " ".join(map(repr, takes.T_WC[1].flatten().tolist())),
    }
    targets = dict(
        zip(texts, ("trajectory", "trajectory", "intrinsics", "intrinsics", "matrix"), strict=True)
    )
    for name, text in texts.items():
        (at / name).write_text(text)
    write_trajectory_tum(at / "run.txt", takes.times_s, takes.T_WC)
    n = torch.Generator().manual_seed(0)
    columns = {
        "xyz_W": (12, 3),
        "log_scale": (12, 3),
        "quat": (12, 4),
        "opacity_logit": (12,),
        "sh": (12, 4, 3),
    }
    write_gaussian_ply(
        at / "g.ply",
        GaussianParams(**{k: torch.rand(s, generator=n) for k, s in columns.items()}),
    )
    mesh = Mesh(
        vertices_W=torch.rand(4, 3),
        faces=torch.tensor([[0, 1, 2], [1, 2, 3]]).int(),
        rgb=torch.rand(4, 3),
    )
    write_mesh_ply(at / "m.ply", mesh)
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property float {a}" for a in "xyz"),
        "element face 1",
    ]
    lines += [
        "property list uchar int vertex_indices",
        "end_header",
        "0 0 0",
        "1 0 0",
        "0 1 0",
        "3 0 1 2",
        "",
    ]
    (at / "text.ply").write_text("\n".join(lines))
    _archives(at, takes)
    targets |= {
        "run.txt": "run_trajectory",
        "g.ply": "gaussians",
        "m.ply": "mesh",
        "text.ply": "mesh",
    }
    targets |= {"a.zip": "archive", "a.tar.gz": "archive", "a.tar": "archive"}
    seeds = []
    for name, target in targets.items():
        folder = root / f"file_{name.replace('.', '_')}"
        folder.mkdir()
        (at / name).rename(folder / name)
        seeds.append(Seed(name, target, folder, name))
    return seeds


def _archives(at: Path, takes) -> None:
    with zipfile.ZipFile(at / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/b.txt", "text " * 30)
        archive.writestr("a/c.png", takes.png(0))
    for mode, name in (("w:gz", "a.tar.gz"), ("w", "a.tar")):
        with tarfile.open(at / name, mode) as archive:  # pyright: ignore[reportCallIssue, reportArgumentType]
            for member, data in (("a/b.txt", b"text " * 30), ("a/c.png", takes.png(0))):
                info = tarfile.TarInfo(member)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))


def _run_folder(root: Path, takes) -> list[Seed]:
    """A finished run, and checkpoints of interrupted ones."""
    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.config import gsfusion
    from gsfusion_nb.runs import run_mapping

    config = gsfusion(
        "replica", tsdf__voxel_size_m=0.2, sh_degree=1, optim__global_iterations=1, data__stop=3
    )
    with use_backend("numba"):
        run_mapping(str(root / "folder"), config, folder=root / "run", evaluate=True)
        of_tests("plugins/box_room.py").Box().folder(root / "scan")
        interrupted = [_interrupted(root, *kind) for kind in INTERRUPTED]
        interrupted += [
            dataclasses.replace(seed, name=f"altered {seed.name}", target="altered")
            for seed in interrupted
        ]
        interrupted.append(_gps_run(root))
    for name in ("run", "gps"):
        interrupted.append(Seed(f"altered_onto {name}", "altered_onto", root / name))
    for name in ("report.html", "mesh.ply"):
        (root / "run" / name).unlink(missing_ok=True)
    return [
        Seed("run", "rescore", root / "run"),
        Seed("config", "settings", root / "run", "config.json"),
        *interrupted,
    ]


INTERRUPTED = (
    ("interrupted", "gsfusion", {}, 2),
    (
        "interrupted_tracked",
        "rtg_slam",
        {"tracking__poses": "tracked", "tracking__back_end": True},
        2,
    ),
    ("interrupted_stream", "gsfusion", {}, 2),
    ("interrupted_gps", "gps_slam", {"tsdf__voxel_size_m": 0.2}, 2),
    ("interrupted_passes", "gsfusion", {}, 4),
    ("interrupted_final", "rtg_slam", {}, 4),
)
"""Name, system, settings, and the steps after which the run was cut off; there are three frames."""


def _interrupted(
    root: Path,
    name: str,
    system: str,
    values: dict,
    n_steps: int,
) -> Seed:
    from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
    from gsfusion_nb.data import open_sequence
    from gsfusion_nb.mapping import make_mapper
    from gsfusion_nb.runs import MappingRun, StreamRun

    values = {"sh_degree": 1, "data__stop": 3, **values}
    if system == "gsfusion":
        values |= {
            "tsdf__voxel_size_m": 0.2,
            "keyframe_min_seeds": 1,
            "optim__global_iterations": 2,
        }
        values |= {"seeding__quadtree_contrast": "std", "seeding__quadtree_threshold": 0.03}
        config = gsfusion("replica", **values)
    elif system == "gps_slam":
        config = gps_slam("replica", **values)
    else:
        values |= {"window__iterations": 2, "final__passes": 2}
        config = rtg_slam("replica", **values)
    sequence = open_sequence(root / "scan", data=config.data)
    if name.endswith("stream"):
        run = StreamRun(list(sequence.mapping), make_mapper(config))
    else:
        run = MappingRun(sequence, make_mapper(config), source={"path_or_name": str(root / "scan")})
    for step, _ in enumerate(itertools.chain(run.online(), run.optimise()), start=1):
        if step == n_steps:
            break
    (root / name).mkdir()
    save_checkpoint(run, root / name)
    return Seed(name, "resume", root / name)


def _gps_run(root: Path) -> Seed:
    """A finished run of GPS-SLAM, whose pictures need its TSDF."""
    from gsfusion_nb.config import gps_slam
    from gsfusion_nb.runs import run_mapping

    config = gps_slam("replica", tsdf__voxel_size_m=0.2, sh_degree=0, data__stop=3)
    run_mapping(str(root / "folder"), config, folder=root / "gps", evaluate=True)
    for name in ("report.html", "mesh.ply"):
        (root / "gps" / name).unlink(missing_ok=True)
    return Seed("gps", "altered_tsdf", root / "gps")


def bombs(root: Path) -> list[Seed]:
    """Small files that ask for more than a gigabyte, and trees of pipes and devices."""
    takes = make_takes()
    zeros = _deflated(BOMB_BYTES)
    scannet = of_tests("recordings/convert/formats/test_scannet.py")
    sens = scannet.write_sens(root / "bomb_sens/a.sens", takes).read_bytes()
    head = sens[: 12 + 8 + 256 + 8 + 28]
    colour = takes.jpeg(0)
    frame = (
        struct.pack(
            "<16f4Q",
            *takes.T_WC[0].flatten(),
            1,
            1,
            len(colour),
            len(zeros),
        )
        + colour
        + zeros
    )
    (root / "bomb_sens/a.sens").write_bytes(head + frame)
    (root / "bomb_r3d").mkdir()
    files = of_tests("recordings/convert/formats/test_record3d.py").members(takes)
    with zipfile.ZipFile(
        root / "bomb_r3d/a.r3d", "w", zipfile.ZIP_DEFLATED, compresslevel=1
    ) as archive:
        for name, data in files.items():
            with archive.open(name, "w") as member:
                member.write(data)
                for _ in range(30 if name == "rgbd/0.depth" else 0):
                    member.write(bytes(10_000_000))
    seeds = [Seed("bomb_sens", "convert", root / "bomb_sens", "a.sens")]
    seeds.append(Seed("bomb_r3d", "convert", root / "bomb_r3d", "a.r3d"))
    header = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b""))
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks
    )
    takes.write(
        root / "bomb_npy/depth/0.npy", b"\x93NUMPY\x01\x00" + _npy_header("(100000, 100000)")
    )
    c = takes.camera
    frame = {
        "file_path": "images/0.png",
        "depth_file_path": "depth/0.npy",
        "transform_matrix": torch.eye(4).tolist(),
    }
    keys = {"fl_x": c.fx, "w": c.width, "h": c.height, "frames": [frame]}
    takes.write(root / "bomb_npy/transforms.json", json.dumps(keys).encode())
    takes.write(root / "bomb_npy/images/0.png", takes.png(0))
    takes.write(
        root / "bomb_png/transforms.json", json.dumps(keys | {"w": 30000, "h": 30000}).encode()
    )
    takes.write(root / "bomb_png/images/0.png", png)
    takes.write(root / "bomb_png/depth/0.npy", (root / "bomb_npy/depth/0.npy").read_bytes())
    seeds += [Seed(n, "convert", root / n) for n in ("bomb_npy", "bomb_png")]
    for name, rows in (
        ("g", "property float x"),
        ("m", "property list uint double vertex_indices"),
    ):
        text = (
            f"ply\nformat binary_little_endian 1.0\nelement face 3\n{rows}\nelement vertex "
            "900000000\n"
        )
        takes.write(
            root / f"bomb_{name}ply/a.ply", (text + f"{rows}\nend_header\n").encode() + bytes(100)
        )
        seeds.append(
            Seed(
                f"bomb_{name}ply",
                {"g": "gaussians", "m": "mesh"}[name],
                root / f"bomb_{name}ply",
                "a.ply",
            )
        )
    takes.write(root / "bomb_tar/a.tar.gz", gzip.compress(bytes(50_000_000), 1))
    seeds.append(Seed("bomb_tar", "archive", root / "bomb_tar", "a.tar.gz"))
    takes.write(root / "bomb_json/K.json", b"[" * 1_000_000)
    seeds.append(Seed("bomb_json", "intrinsics", root / "bomb_json", "K.json"))
    return seeds


def _npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return struct.pack("<H", len(text)) + text.encode()


def _deflated(n_bytes: int) -> bytes:
    """A zlib stream of zeros: one packed block again and again. Its checksum is wrong, which shows
    after the end."""
    packer = zlib.compressobj(1)
    block = bytes(10_000_000)
    first = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + again * (n_bytes // len(block)) + packer.flush()
