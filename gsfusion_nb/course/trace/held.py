"""The records of a trace within a limit of memory."""

from collections import deque
from collections.abc import Callable, Iterator

from torch import Tensor

from .records import Record


class HeldRecords:
    """The newest records. When they hold more than ``limit_bytes``, the oldest is given to ``leaves`` and dropped.

    A tensor that several records share is counted once. The newest record is always held.
    """

    def __init__(self, limit_bytes: int, leaves: Callable[[Record], None]):
        self.limit_bytes, self._leaves = limit_bytes, leaves
        self._records: deque[Record] = deque()
        self._users: dict[int, list[int]] = {}
        """Address of a storage -> [records that hold it, bytes]."""
        self.n_dropped = 0

    def __iter__(self) -> Iterator[Record]:
        return iter(tuple(self._records))

    def __len__(self) -> int:
        return len(self._records)

    @property
    def memory_bytes(self) -> int:
        """Memory of the tensors that are held, bytes."""
        return sum(size for _, size in self._users.values())

    def add(self, record: Record) -> None:
        """Hold a record."""
        self._records.append(record)
        for address, size in _storages(record).items():
            self._users.setdefault(address, [0, size])[0] += 1
        while self.memory_bytes > self.limit_bytes and len(self._records) > 1:
            self._leaves(self._records[0])
            self._forget(self._records.popleft())
            self.n_dropped += 1

    def cut(self, serial: int) -> None:
        """Forget the records from ``serial`` on."""
        while self._records and self._records[-1].serial >= serial:
            self._forget(self._records.pop())

    def _forget(self, record: Record) -> None:
        for address in _storages(record):
            self._users[address][0] -= 1
            if not self._users[address][0]:
                del self._users[address]


def _storages(record: Record) -> dict[int, int]:
    def storage(tensor: Tensor) -> tuple[int, int]:
        held = tensor.untyped_storage()
        return held.data_ptr(), held.nbytes()

    return dict(storage(tensor) for tensor in record.tensors() if tensor.numel())
