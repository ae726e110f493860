"""How much memory is left, and how much a piece of work needs."""

import contextlib
import ctypes
import gc
from pathlib import Path

import torch


def available_memory(device: torch.device) -> int | None:
    """Bytes that can still be allocated on ``device``; None where the system does not report it."""
    if device.type == "cuda":
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
    """Growth of memory inside a block, ``peak_mb``: the largest resident set minus that at the start.

    Linux stores the largest resident set of a process, and the process can reset it; on other systems the result is
    None. On a GPU it is the memory that torch allocated.
    """

    def __init__(self, device: str = "cpu"):
        self.device = device
        self.peak_mb: float | None = None
        self._before = 0

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        if self.device == "cuda":
            torch.cuda.reset_peak_memory_stats()
            self._before = torch.cuda.memory_allocated()
            return self
        _return_free_memory()
        self._before = _resident_bytes("VmRSS") if _reset_peak() else -1
        return self

    def __exit__(self, *_) -> None:
        if self.device == "cuda":
            self.peak_mb = (torch.cuda.max_memory_allocated() - self._before) / 1e6
        elif self._before >= 0:
            self.peak_mb = max(0, _resident_bytes("VmHWM") - self._before) / 1e6


def _resident_bytes(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    return 0


def _reset_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): resets VmHWM to the current resident set
    except OSError:
        return False
    return True


def _return_free_memory() -> None:
    """Return freed memory to the system; otherwise work that reuses it would seem to need none."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def memory_is_full(error: BaseException) -> bool:
    """Whether an error says, in the words of Python, torch, OpenCV or C++, that there is no more memory."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    text = str(error)
    return any(
        words in text for words in ("can't allocate memory", "bad_alloc", "Insufficient memory", "Cannot allocate")
    )
