"""Which other programs can be measured beside ours here; the others are named with what would install them."""

import importlib
import importlib.metadata
import warnings
from collections.abc import Callable
from dataclasses import dataclass

from . import gsplat_cuda


@dataclass(frozen=True, kw_only=True)
class Peer:
    """Another program that does the same work."""

    name: str
    section: str
    package: str
    """Distribution whose version is stated."""
    module: str
    remedy: str
    needs: Callable[[object], bool] = lambda module: True
    lacks: str = ""
    """What is missing if ``needs`` fails."""


PEERS = {
    "gsplat": Peer(
        name="gsplat (torch path)",
        section="raster",
        package="gsplat",
        module="gsplat.cuda._torch_impl",
        remedy="pip install gsplat==1.5.3",
        needs=lambda module: hasattr(module, "_rasterize_to_pixels"),
        lacks="its torch path is not where version 1.5 has it",
    ),
    "gsplat_cuda": Peer(
        name="gsplat (CUDA)",
        section="raster",
        package="gsplat",
        module="gsplat",
        remedy="a GPU, nvcc, and pip install gsplat==1.5.3",
        needs=gsplat_cuda.is_built,
        lacks="no GPU, or its CUDA kernels could not be built",
    ),
    "open3d": Peer(
        name="Open3D VoxelBlockGrid",
        section="tsdf",
        package="open3d",
        module="open3d",
        remedy="pip install open3d",
    ),
    "opencv": Peer(
        name="OpenCV HashTSDF",
        section="tsdf",
        package="opencv-python-headless",
        module="cv2",
        remedy="pip install 'opencv-python-headless>=5'",
        needs=lambda module: hasattr(module, "VolumeSettings"),
        lacks="its volume is in version 5 and later",
    ),
}


def why_not(name: str) -> str | None:
    """None if the peer can be measured, else the reason and what to do."""
    peer = PEERS[name]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Open3D warns that there is no GPU; its table row says what it ran on
            module = importlib.import_module(peer.module)
    except ImportError as e:
        missing = e.name and e.name.split(".")[0] == peer.module.split(".")[0]
        reason = "not installed" if missing else f"cannot be imported ({e})"
        return f"{reason}: {peer.remedy}"
    return None if peer.needs(module) else f"{peer.lacks}: {peer.remedy}"


def version(name: str) -> str | None:
    """Installed version of a peer."""
    try:
        return importlib.metadata.version(PEERS[name].package)
    except importlib.metadata.PackageNotFoundError:
        return None
