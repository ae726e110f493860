"""``gsfusion-nb export``: the maps of a run, or a file of Gaussians, for other programs, right side
up."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from ..config.options import named
from ..errors import ArgumentError
from ..types import Camera, GaussianParams, Mesh
from .settings import system_names

_AS_IN_FILES = "-y"
"""Up in files of Gaussians that come without a trajectory: most trainers start from the first
camera."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write the maps of a run, or a file of Gaussians, for other programs, right side up.

    A .glb file holds Gaussians and mesh in one frame, y up; a .usda file (OpenUSD) holds also the
    moving camera; a .ply file holds the Gaussians, -y up (of GPS-SLAM with its surface as discs); a
    folder gets gaussians.ply and mesh.ply in one frame, -y up, and map.glb."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or a .ply file of Gaussians."""
    out: Annotated[Path, tyro.conf.Positional]
    """File to write, .glb, .usda or .ply, or a folder."""
    up: str = "auto"
    """Direction of the map that points up: +x, -x, +y, -y, +z, -z, or three numbers such as
    0.1,0,1. Default: the mean of the cameras' up directions in the run's trajectory; without a
    trajectory -y."""
    upright: bool = True
    """Turn .ply files so that -y is up, as viewers of splats expect. Other files are always
    upright."""
    mesh: bool = True
    """Put the mesh of a run into a .glb or .usda file."""
    system: str = named("", system_names)
    """System of the run; needed only if it came from a file, FILE.py:Name, which is executed, and
    its surface becomes discs."""
    bake_steps: int = 200
    """A run of GPS-SLAM draws its Gaussians over a surface. In a .ply file the surface becomes
    discs, and all are fitted to this many pictures of the map; 0: no fit, which is quick and less
    sharp; -1: no discs, the corrections alone, which show little over black."""


def run(options: ExportOptions) -> int:
    """The command. Exit status 0: the files are written."""
    from ..export import write_gaussian_ply, write_map_glb, write_map_usda, write_mesh_ply
    from ..gaussians.rigid_motion import move_params
    from ..geometry.upright import turn_to_minus_y_up

    gaussians, mesh = _read(options.source)
    standard = _standard(options, gaussians)
    up, how = _up_direction(options)
    print(f"Up is {_axis_name(up)} in the map: {how}.")
    R = turn_to_minus_y_up(up) if options.upright else torch.eye(3).double()
    suffix = options.out.suffix.lower()
    files = []
    if suffix == ".glb" or not suffix:
        files.append(options.out if suffix else options.out / "map.glb")
        write_map_glb(files[0], gaussians, mesh if options.mesh else None, up=up)
    if suffix == ".usda":
        files.append(options.out)
        write_map_usda(
            options.out,
            gaussians,
            mesh if options.mesh else None,
            up=up,
            **_moving_camera(options.source),
        )
    if suffix == ".ply" or not suffix:
        files.append(options.out if suffix else options.out / "gaussians.ply")
        write_gaussian_ply(files[-1], move_params(standard, R) if options.upright else standard)
    if not suffix and mesh is not None:
        files.append(options.out / "mesh.ply")
        vertices_W = (mesh.vertices_W.double() @ R.T).float()
        write_mesh_ply(files[-1], dataclasses.replace(mesh, vertices_W=vertices_W))
    if not files:
        raise ArgumentError(f"{options.out} must end in .glb, .usda or .ply, or be a folder")
    for path in files:
        frame = (
            "+y up"
            if path.suffix in (".glb", ".usda")
            else "-y up"
            if options.upright
            else "in the frame of the map"
        )
        print(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB, {frame})")
    return 0


def _read(source: Path) -> tuple[GaussianParams, Mesh | None]:
    """The Gaussians, and the mesh where there is one."""
    from ..export import read_gaussian_ply, read_mesh_ply

    if not source.is_dir():
        return read_gaussian_ply(source), None
    mesh = source / "mesh.ply"
    return read_gaussian_ply(source / "gaussians.ply", strict=True), read_mesh_ply(
        mesh
    ) if mesh.is_file() else None


def _moving_camera(source: Path) -> dict[str, Any]:
    """Intrinsics, poses and times of a run; empty, with a sentence, where the source does not have
    them."""
    from ..export import read_trajectory_tum
    from ..files import parsing, read_object

    file = source / "config.json"
    settings = read_object(file, "the settings of a run") if file.is_file() else {}
    if "camera" not in settings:
        print(f"{source} does not say which camera it was mapped with, so the stage has none.")
        return {}
    times_s, poses = read_trajectory_tum(source / "trajectory.txt")
    with parsing(
        source / "config.json",
        "the settings of a run, with width, height, fx, fy, cx and cy of its camera",
    ):
        camera = Camera(**settings["camera"])
    return {"camera": camera, "poses": poses, "times_s": times_s}


def _standard(options: ExportOptions, gaussians: GaussianParams) -> GaussianParams:
    """The Gaussians for a .ply file: a surface that they are drawn over as discs, too."""
    from ..config import from_run
    from ..export import read_trajectory_tum
    from ..export.tsdf_file import TSDF
    from ..files import parsing, read_object
    from ..runs.system_of_run import system_of_run

    folder = options.source
    if (
        not (folder / TSDF).is_file()
        or options.bake_steps < 0
        or options.out.suffix.lower() in (".glb", ".usda")
    ):
        return gaussians
    settings = read_object(folder / "config.json", "the settings of a run", objects=("config",))
    if settings.get("drawn_over_volume") is False:
        return gaussians
    system = system_of_run(folder, settings, options.system or None)
    with parsing(folder / "config.json", "the settings of a run"):
        config = from_run(system.config_type, settings["config"])
    if not system.description.needs_volume_to_render:
        return gaussians
    trajectory = folder / "trajectory.txt"
    poses = read_trajectory_tum(trajectory)[1].float() if trajectory.is_file() else []
    print(
        f"{folder.name} is drawn over its TSDF: making discs of it, and {options.bake_steps} steps "
        "to fit them ..."
    )
    gaussians = dataclasses.replace(
        gaussians,
        sh=gaussians.sh[:, : (config.sh_degree + 1) ** 2].contiguous(),
    )
    standard = system.files_type.standard_from(
        folder, gaussians, config, list(poses), options.bake_steps
    )
    print(
        f"{len(standard) - len(gaussians):,} discs for the surface, {len(gaussians):,} Gaussians "
        "in front of it"
    )
    return standard


def _up_direction(options: ExportOptions) -> tuple[torch.Tensor, str]:
    """The up direction, and how it was found."""
    from ..export import read_trajectory_tum
    from ..geometry.upright import up_vector, world_up

    if options.up != "auto":
        word = options.up
        numbers = word.split(",")
        return up_vector(tuple(map(float, numbers)) if len(numbers) == 3 else word), "as --up says"
    trajectory = options.source / "trajectory.txt"
    if options.source.is_dir() and trajectory.is_file():
        _, poses = read_trajectory_tum(trajectory)
        return world_up(
            list(poses)
        ), f"the mean of the up directions of {len(poses)} cameras, {trajectory.name}"
    return up_vector(
        _AS_IN_FILES
    ), "files of Gaussians have -y up, and there is no trajectory; --up changes it"


def _axis_name(up: torch.Tensor) -> str:
    from ..geometry.upright import UP_AXES, up_vector

    axis = next(
        (name for name in UP_AXES if torch.equal(up_vector(name), up.double())),
        None,
    )
    return axis or "({:.2f}, {:.2f}, {:.2f})".format(*up.tolist())
