"""Kernels for NVIDIA GPUs in Triton, compiled on first use and cached on disk.

With ``TRITON_INTERPRET=1`` set before Python starts, Triton's interpreter runs them on CPU tensors:
slow, for tests.
"""

import torch

from gsfusion_nb.backends import BackendUnavailable

from .launch import INTERPRETED

if not (INTERPRETED or torch.cuda.is_available()):
    raise BackendUnavailable(
        "backend 'triton' needs an NVIDIA GPU, and torch sees none (in tests: TRITON_INTERPRET=1)"
    )
