"""The Triton kernels against the reference: on a GPU where there is one, else on CPU tensors under
the interpreter."""

import pytest


@pytest.fixture
def backend() -> str:
    return "triton"
