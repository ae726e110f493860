"""The torch backend cuts its work into chunks of list entries and tiles; the result does not depend on their size."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.kernels.composite import entries as chunks
from gsfusion_nb.kernels.composite.cases import cases


@pytest.mark.parametrize("size", [(3, 2), (1, 1), (7, 1000)], ids=["many", "one entry each", "all tiles"])
@pytest.mark.parametrize("case", list(cases())[:-1], ids=lambda case: case.name)
def test_chunks_do_not_show(case, size, monkeypatch):
    with use_backend("reference"):
        expected = case.run(torch.device("cpu"), torch.float64)
    monkeypatch.setattr(chunks, "RANKS", size[0])
    monkeypatch.setattr(chunks, "TILES", size[1])
    with use_backend("torch"):
        found = case.run(torch.device("cpu"), torch.float64)
    for name, value in expected.items():
        torch.testing.assert_close(
            found[name], value, atol=1e-9 * float(value.double().abs().max()) if value.numel() else 0, rtol=1e-9
        )
