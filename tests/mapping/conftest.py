"""Comparison of states, for several tests of mappers."""

from typing import Any

import pytest
import torch


@pytest.fixture(scope="session")
def same():
    """A function that asserts that two states are equal, bit for bit."""

    def same(a: Any, b: Any, path: str = "state") -> None:
        """Two states are equal, bit for bit."""
        if isinstance(a, torch.Tensor):
            assert torch.equal(a, b), path
        elif isinstance(a, dict):
            assert a.keys() == b.keys(), path
            for key in a:
                same(a[key], b[key], f"{path}.{key}")
        elif isinstance(a, (list, tuple)):
            assert len(a) == len(b), path
            for i, (x, y) in enumerate(zip(a, b, strict=True)):
                same(x, y, f"{path}[{i}]")
        else:
            assert a == b, path

    return same
