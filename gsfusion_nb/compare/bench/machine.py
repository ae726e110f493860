"""Description of the machine on which the bench runs."""

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from ... import __version__
from .other_programs import OTHER_PROGRAMS, version

PACKAGES = ("torch", "numpy", "numba", "llvmlite", "triton")


def describe(threads: int) -> dict[str, Any]:
    """Processor, memory, versions, and the load from other programs."""
    import torch

    versions: dict[str, str | None] = {"gsfusion_nb": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    versions |= {program.package: version(name) for name, program in OTHER_PROGRAMS.items()}
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gb": _memory_gb(),
        "system": f"{platform.system()} {platform.machine()}",
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "threads": threads,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "date": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "versions": versions,
    }


def header(machine: dict[str, Any]) -> list[str]:
    """``describe`` in a few lines of text."""
    memory = f", {machine['memory_gb']:.0f} GB" if machine["memory_gb"] else ""
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    threads = f"{machine['threads']} thread{'s' if machine['threads'] > 1 else ''} of {machine['cores']} cores"
    lines = [
        f"{machine['processor']}{memory}{gpu}; {threads}; {machine['date'][:16].replace('T', ' ')}",
        ", ".join(f"{name} {v}" for name, v in machine["versions"].items() if v),
    ]
    load = machine["load_average"]
    if load is not None and load > 0.5:
        lines.append(f"Other programs used {load:.1f} cores just before; this affects wall time more than CPU time.")
    return lines


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    names = getattr(os, "sysconf_names", {})
    if "SC_PHYS_PAGES" not in names or "SC_PAGE_SIZE" not in names:
        return None
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
