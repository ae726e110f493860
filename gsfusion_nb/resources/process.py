"""What this process may use, and how much it uses: cores and memory."""

import contextlib
import ctypes
import gc
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory(device: "torch.device") -> int | None:
    """Bytes that can still be allocated on ``device``; None where the system does not report it."""
    if device.type == "cuda":
        import torch

        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    meminfo = Path("/proc/meminfo")
    if device.type != "cpu" or not meminfo.exists():
        return None
    for line in meminfo.read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


class PeakMemory:
    """Growth of memory inside a block, ``peak_mb``: the largest resident set minus that at the
    start.

    Linux stores the largest resident set of a process, and the process can reset it; on other
    systems the result is None. On a GPU it is the memory that torch allocated.
    """

    def __init__(self, device: str = "cpu"):
        self.device = device
        self.peak_mb: float | None = None
        self._start_bytes = 0

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        if self.device == "cuda":
            import torch

            torch.cuda.reset_peak_memory_stats()
            self._start_bytes = torch.cuda.memory_allocated()
            return self
        return_free_memory()
        self._start_bytes = resident_bytes("VmRSS") if _reset_peak() else -1
        return self

    def __exit__(self, *_) -> None:
        if self.device == "cuda":
            import torch

            self.peak_mb = (torch.cuda.max_memory_allocated() - self._start_bytes) / 1e6
        elif self._start_bytes >= 0:
            self.peak_mb = max(0, resident_bytes("VmHWM") - self._start_bytes) / 1e6


def resident_bytes(field: str) -> int:
    """A line of Linux's account of this process: "VmRSS", its memory now, or "VmHWM", the most that
    it had; 0 on other systems."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    return 0


def _reset_peak() -> bool:
    try:
        # proc(5): resets VmHWM to the current resident set
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def return_free_memory() -> None:
    """Return freed memory to the system, also between what is in use."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL("libc.so.6").malloc_trim(0)
