"""Other programs to compare with: which can be measured on this machine, and how to install the rest."""

import importlib
import importlib.metadata
import warnings
from collections.abc import Callable
from dataclasses import dataclass

from . import gsplat_cuda


@dataclass(frozen=True, kw_only=True)
class OtherProgram:
    """Another program with the same function."""

    name: str
    section: str
    package: str
    """Distribution whose version is reported."""
    module: str
    remedy: str
    needs: Callable[[object], bool] = lambda module: True
    lacks: str = ""
    """Message if ``needs`` fails."""


OTHER_PROGRAMS = {
    "gsplat": OtherProgram(
        name="gsplat (torch path)",
        section="raster",
        package="gsplat",
        module="gsplat.cuda._torch_impl",
        remedy="pip install gsplat==1.5.3",
        needs=lambda module: hasattr(module, "_rasterize_to_pixels"),
        lacks="it is not version 1.5, whose torch path is used",
    ),
    "gsplat_cuda": OtherProgram(
        name="gsplat (CUDA)",
        section="raster",
        package="gsplat",
        module="gsplat",
        remedy="a GPU, nvcc, and pip install gsplat==1.5.3",
        needs=gsplat_cuda.is_built,
        lacks="no GPU, or its CUDA kernels could not be built",
    ),
    "open3d": OtherProgram(
        name="Open3D VoxelBlockGrid",
        section="tsdf",
        package="open3d",
        module="open3d",
        remedy="pip install open3d",
    ),
    "opencv": OtherProgram(
        name="OpenCV HashTSDF",
        section="tsdf",
        package="opencv-python-headless",
        module="cv2",
        remedy="pip install 'opencv-python-headless>=5'",
        needs=lambda module: hasattr(module, "VolumeSettings"),
        lacks="its volume needs version 5 or later",
    ),
}


def why_not(name: str) -> str | None:
    """None if the program can be measured, else the reason and what to do."""
    program = OTHER_PROGRAMS[name]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Open3D warns if there is no GPU; the table shows the device
            module = importlib.import_module(program.module)
    except ImportError as e:
        missing = e.name and e.name.split(".")[0] == program.module.split(".")[0]
        reason = "not installed" if missing else f"cannot be imported ({e})"
        return f"{reason}: {program.remedy}"
    return None if program.needs(module) else f"{program.lacks}: {program.remedy}"


def version(name: str) -> str | None:
    """Installed version of a program."""
    try:
        return importlib.metadata.version(OTHER_PROGRAMS[name].package)
    except importlib.metadata.PackageNotFoundError:
        return None
