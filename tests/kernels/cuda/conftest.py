"""The CUDA kernels against the reference: on a GPU where there is one, else on CPU tensors in the
emulator."""

import pytest


@pytest.fixture
def backend() -> str:
    return "cuda"
