"""What a run's maps depend on besides its data and settings: versions, the backend, the
processor."""

import importlib.metadata
import platform
from collections.abc import Mapping

import torch

from .. import __version__
from ..backends import chosen

_LIBRARIES = {"PyTorch": "torch", "NumPy": "numpy", "numba": "numba", "triton": "triton"}
"""Name -> distribution of each library whose version may change how numbers are rounded."""


def ran_on(device: torch.device) -> dict[str, str]:
    """What a map on this device is made with now, by name; runs of which all is equal have equal
    maps, bit for bit."""
    versions = {
        "gsfusion_nb": __version__,
        "backend": chosen(),
        "device": device.type,
        "Python": platform.python_version(),
    }
    versions |= {name: _version(distribution) for name, distribution in _LIBRARIES.items()}
    versions["system"] = f"{platform.system()} {platform.machine()}"
    versions["processor"] = torch.backends.cpu.get_cpu_capability()
    if device.type == "cuda":
        versions["GPU"] = torch.cuda.get_device_name(device)
    return versions


def difference(stored: Mapping[str, str], current: Mapping[str, str]) -> str:
    """What differs between two results of ``ran_on``, in words; empty if nothing does."""
    names = (name for name in {**stored, **current} if stored.get(name) != current.get(name))
    return ", ".join(
        f"{name} {current.get(name, 'none')} instead of {stored.get(name, 'none')}"
        for name in names
    )


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def environment() -> dict[str, str]:
    """Versions and threads of this process."""
    return {
        "gsfusion_nb": __version__,
        "Python": platform.python_version(),
        "PyTorch": torch.__version__,
        "threads": str(torch.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
    }
