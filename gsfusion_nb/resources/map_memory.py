"""Where the tensors of a map are: in memory, or in temporary files for a map that is larger."""

import math
import mmap
import os
import tempfile
import weakref
from typing import TYPE_CHECKING, Any

from ..errors import ArgumentError, MemoryFullError
from .process import resident_bytes, return_free_memory

if TYPE_CHECKING:
    import torch

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

    def map(self, n_bytes: int) -> mmap.mmap:
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
        self._shared_file: torch.Tensor | None = None
        """The last file that tensors share, and how many bytes of it are used."""
        self._n_filled = 0
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
            return self._tensor_of(_File(), math.prod(shape), like.dtype).view(shape)
        n_bytes = math.prod(shape) * like.itemsize
        try:
            pages = mmap.mmap(-1, n_bytes, **_PRIVATE)
        except OSError as e:
            raise MemoryFullError(f"no {n_bytes / 1e6:.0f} MB for a part of the map: {e}") from e
        return torch.frombuffer(pages, dtype=like.dtype).view(shape)

    def extend(self, old: "torch.Tensor", n: int) -> "torch.Tensor":
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
        return self._tensor_of(file, n * math.prod(old.shape[1:]), old.dtype).view(
            n, *old.shape[1:]
        )

    def in_file(self, values: "torch.Tensor") -> "torch.Tensor":
        """The same values in a file that many tensors share, whether there is a limit or not."""
        import torch

        if self._shared_file is None or self._n_filled + values.nbytes > len(self._shared_file):
            self._shared_file = self._tensor_of(
                _File(),
                max(values.nbytes, _SHARED_BYTES),
                torch.uint8,
            )
            self._n_filled = 0
        place = self._shared_file[self._n_filled : self._n_filled + values.nbytes]
        self._n_filled += -(-values.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return place.view(values.dtype).view(values.shape).copy_(values)

    def _tensor_of(self, file: _File, n: int, dtype: "torch.dtype") -> "torch.Tensor":
        import torch

        pages = file.map(n * dtype.itemsize)
        values = torch.frombuffer(pages, dtype=dtype)
        self._files[values.data_ptr()] = weakref.ref(pages), file
        weakref.finalize(pages, self._files.pop, values.data_ptr(), None)
        return values

    def give_back(self) -> None:
        """Leave the pages of all files to the system if this process has more memory than the
        limit."""
        if self.limit_bytes is None or resident_bytes("VmRSS") <= self._next_bytes:
            return
        for pages_of, _ in self._files.values():
            if (pages := pages_of()) is not None:
                pages.madvise(mmap.MADV_DONTNEED)
        return_free_memory()
        self._next_bytes = max(self.limit_bytes, resident_bytes("VmRSS") + self.limit_bytes // 8)


MAP_MEMORY = MapMemory()
"""Of this process."""
