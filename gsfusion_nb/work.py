"""Long work: its progress, how much memory is left, and a map that is larger than memory."""

import contextlib
import ctypes
import gc
import math
import mmap
import os
import sys
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

from .errors import ArgumentError, MemoryFullError

if TYPE_CHECKING:
    import torch

T = TypeVar("T")

EVERY_S = 10.0
"""Time between two lines of a log, seconds; shorter work writes none."""


class ProgressDisplay:
    """Progress of one piece of work, as a context manager: tqdm's bar, or a line every ``EVERY_S``
    seconds in a log.

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
            desc=what,
            total=total,
            unit=unit or "it",
            unit_scale=unit == "B",
            initial=done,
            leave=leave,
            file=to,
            disable=not shown or stored,
            mininterval=pause_s,
            maxinterval=EVERY_S,
            delay=0 if pause_s < EVERY_S else EVERY_S,
        )

    def show(
        self,
        done: int,
        *,
        total: int | None = None,
        what: str | None = None,
        note: str = "",
    ) -> None:
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
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and "IPKernelApp" in shell.config


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_SHARED_BYTES = 1 << 26
_ALIGNED_BYTES = 64
_PRIVATE: Any = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if os.name == "posix" else {}
"""Memory in small pages, of which those that are not used take none. numpy asks for huge ones, and
a map that grows waits for each of them: in a building of 64 rooms GPS-SLAM's frames took a quarter
longer."""


class _File:
    """A temporary file of zeros, which is gone when nothing uses it. ``/tmp`` is often in
    memory."""

    def __init__(self) -> None:
        self._folder = (
            "/var/tmp" if "TMPDIR" not in os.environ and os.path.isdir("/var/tmp") else None
        )
        with tempfile.TemporaryFile(dir=self._folder, prefix="gsfusion-map-") as file:
            self._handle = os.dup(file.fileno())
        weakref.finalize(self, os.close, self._handle)

    def mapped(self, n_bytes: int) -> mmap.mmap:
        """The file in memory, made as long as that; earlier maps of it show the same values."""
        try:
            os.truncate(self._handle, n_bytes)
            # else a full disk would kill the process at the first write
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._handle, 0, n_bytes)
        except OSError as e:
            raise MemoryFullError(
                f"no {n_bytes / 1e6:.0f} MB for a part of the map in "
                f"{self._folder or tempfile.gettempdir()}: {e}"
            ) from e
        return mmap.mmap(self._handle, n_bytes)


class MapMemory:
    """Where the tensors of a map are: in memory, or on a processor in temporary files that are
    mapped into memory.

    Files hold what memory does not: ``give_back`` leaves their pages to the system, which reads
    them again when they are used, so the map has the same bits. Use ``MAP_MEMORY``, the only one.
    """

    def __init__(self) -> None:
        self.limit_bytes: int | None = None
        """Memory of this process above which pages are given back; None: no files are used."""
        self._files: dict[int, tuple[weakref.ref[mmap.mmap], _File]] = {}
        """Place in memory -> the file that is mapped there."""
        self._shared: torch.Tensor | None = None
        """The last file that tensors share, and how many bytes of it are used."""
        self._used = 0
        self._next_bytes = 0

    def limit(self, gb: float | None) -> None:
        """Set the limit, GB, for tensors that are made from now on; None: no limit.

        Raises:
            ValueError: ``gb`` is not above 0, or this system cannot give pages back.
        """
        if gb is not None and not (gb > 0 and hasattr(mmap, "MADV_DONTNEED")):
            raise ArgumentError(
                f"the limit of memory must be above 0 GB and the system not Windows, got {gb} GB"
            )
        self.limit_bytes = None if gb is None else int(gb * 1e9)
        self._next_bytes = int((gb or 0) * 1e9)

    def is_in_files(self, device: "torch.device") -> bool:
        """Whether new tensors on this device are in files."""
        return self.limit_bytes is not None and device.type == "cpu"

    def rows(
        self, *shape: int, dtype: "torch.dtype | None" = None, device: "torch.device"
    ) -> "torch.Tensor":
        """A tensor of zeros, for rows of which on a processor those that are not used need no
        memory.

        Raises:
            MemoryError: the system does not grant it, or the disk has no space for its file.
        """
        import torch

        like = torch.zeros(0, dtype=dtype, device=device)
        if device.type != "cpu" or 0 in shape:
            return like.new_zeros(shape)
        if self.is_in_files(device):
            return self._mapped(_File(), math.prod(shape), like.dtype).view(shape)
        n_bytes = math.prod(shape) * like.itemsize
        try:
            pages = mmap.mmap(-1, n_bytes, **_PRIVATE)
        except OSError as e:
            raise MemoryFullError(f"no {n_bytes / 1e6:.0f} MB for a part of the map: {e}") from e
        return torch.frombuffer(pages, dtype=like.dtype).view(shape)

    def grown(self, old: "torch.Tensor", n: int) -> "torch.Tensor":
        """The rows of a tensor made by ``rows``, and more up to ``n``, which are zero; in a file
        nothing is copied.

        Raises:
            MemoryError: as for ``rows``; ``old`` is unchanged.
        """
        if old.data_ptr() not in self._files:
            new = self.rows(
                n,
                *old.shape[1:],
                dtype=old.dtype,
                device=old.device,
            )
            new[: len(old)] = old
            return new
        _, file = self._files[old.data_ptr()]
        return self._mapped(file, n * math.prod(old.shape[1:]), old.dtype).view(n, *old.shape[1:])

    def in_file(self, values: "torch.Tensor") -> "torch.Tensor":
        """The same values in a file that many tensors share, whether there is a limit or not."""
        import torch

        if self._shared is None or self._used + values.nbytes > len(self._shared):
            self._shared = self._mapped(
                _File(),
                max(values.nbytes, _SHARED_BYTES),
                torch.uint8,
            )
            self._used = 0
        place = self._shared[self._used : self._used + values.nbytes]
        self._used += -(-values.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return place.view(values.dtype).view(values.shape).copy_(values)

    def _mapped(self, file: _File, n: int, dtype: "torch.dtype") -> "torch.Tensor":
        import torch

        mapped = file.mapped(n * dtype.itemsize)
        values = torch.frombuffer(mapped, dtype=dtype)
        self._files[values.data_ptr()] = weakref.ref(mapped), file
        weakref.finalize(mapped, self._files.pop, values.data_ptr(), None)
        return values

    def give_back(self) -> None:
        """Leave the pages of all files to the system if this process has more memory than the
        limit."""
        if self.limit_bytes is None or _resident_bytes("VmRSS") <= self._next_bytes:
            return
        for mapped, _ in self._files.values():
            if (file := mapped()) is not None:
                file.madvise(mmap.MADV_DONTNEED)
        return_free_memory()
        self._next_bytes = max(self.limit_bytes, _resident_bytes("VmRSS") + self.limit_bytes // 8)


MAP_MEMORY = MapMemory()
"""Of this process."""


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
        self._before = 0

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        if self.device == "cuda":
            import torch

            torch.cuda.reset_peak_memory_stats()
            self._before = torch.cuda.memory_allocated()
            return self
        return_free_memory()
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
        # proc(5): resets VmHWM to the current resident set
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def return_free_memory() -> None:
    """Return freed memory to the system, also between what is in use."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL("libc.so.6").malloc_trim(0)
