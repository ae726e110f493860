"""Long work: its progress, and how much memory is left."""

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

if TYPE_CHECKING:
    import torch

T = TypeVar("T")

EVERY_S = 10.0
"""Time between two lines of a log, seconds; shorter work writes none."""

GROWTH = {"cpu": 2.0, "cuda": 1.25}
"""A map that is full grows by this factor. Untouched memory is free on a CPU; on a GPU it is taken from the rest."""


class ProgressDisplay:
    """Progress of one piece of work, as a context manager: tqdm's bar, or a line every ``EVERY_S`` seconds in a log.

        with ProgressDisplay("mapping", total=len(frames), unit="frame") as progress:
            for n, frame in enumerate(frames, start=1):
                ...
                progress.show(n, note=f"PSNR {psnr_db:.1f} dB")

    Args:
        what: What is being done, a word or two.
        total: How much there is to do; None if that is not known (yet).
        unit: What is counted, in the singular; "B" for bytes, which are shown in kB, MB or GB.
        done: How much was done before.
        leave: Whether the bar is kept when the work is done.
        shown: False shows nothing at all.
        stream: Where to; standard error by default.
    """

    def __init__(
        self,
        what: str,
        *,
        total: int | None = None,
        unit: str = "",
        done: int = 0,
        leave: bool = True,
        shown: bool = True,
        stream: TextIO | None = None,
    ):
        from tqdm.auto import tqdm

        to: TextIO = stream or sys.stderr
        stored = os.environ.get("GSNB_VIEW") == "static"  # a notebook that is executed to be read
        pause_s = 0.1 if to.isatty() or _in_notebook() else EVERY_S
        self._bar = tqdm(
            desc=what, total=total, unit=unit or "it", unit_scale=unit == "B", initial=done, leave=leave, file=to,
            disable=not shown or stored, mininterval=pause_s, maxinterval=EVERY_S,
            delay=0 if pause_s < EVERY_S else EVERY_S,
        )  # fmt: skip

    def show(self, done: int, *, total: int | None = None, what: str | None = None, note: str = "") -> None:
        """Say how much is done now.

        Args:
            done: In all.
            total: How much there is to do, if that has changed.
            what: In place of what was said at first.
            note: More about the present state.
        """
        if total is not None:
            self._bar.total = total
        if what is not None:
            self._bar.set_description_str(what, refresh=False)
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items one after another; each counts as done when the next one is asked for."""
        for done, item in enumerate(items, start=1):
            yield item
            self.show(done)

    def close(self) -> None:
        """The work is over, finished or not."""
        self._bar.close()

    def __enter__(self) -> "ProgressDisplay":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def _in_notebook() -> bool:
    """Whether a Jupyter kernel shows what is printed."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    shell = get_ipython()
    return shell is not None and "IPKernelApp" in shell.config


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
            import torch

            torch.cuda.reset_peak_memory_stats()
            self._before = torch.cuda.memory_allocated()
            return self
        _return_free_memory()
        self._before = _resident_bytes("VmRSS") if _reset_peak() else -1
        return self

    def __exit__(self, *_) -> None:
        if self.device == "cuda":
            import torch

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
