"""How often tensors were changed in place: what was computed from them holds while the count is the
same.

This is the only file that asks PyTorch for its count.
"""

import itertools

from torch import Tensor

_NEVER_THE_SAME = itertools.count()


def edit_count(*tensors: Tensor) -> tuple[int, ...]:
    """A value that is another one when any of the tensors was changed, or is in another place.

    PyTorch counts every operation in place, on a tensor and on all that share its memory as views.
    Where it does not (``is_counted``), each call gives another value, so no change is missed. Who
    writes to memory past PyTorch says so with ``torch.autograd.graph.increment_version``, as the
    kernels do; NumPy's arrays and ``Tensor.data`` do not.
    """
    counts = (t._version if is_counted(t) else -next(_NEVER_THE_SAME) for t in tensors)
    return (*(t.data_ptr() for t in tensors), *counts)


def is_counted(tensor: Tensor) -> bool:
    """Whether PyTorch counts the changes of a tensor: not if it was made in inference mode."""
    return not tensor.is_inference()
