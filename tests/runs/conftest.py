import pytest

from gsfusion_nb.runs import outputs


@pytest.fixture(autouse=True)
def _few_samples_of_surfaces(monkeypatch):
    """A tenth is enough for surfaces whose error is centimetres."""
    monkeypatch.setattr(outputs, "SURFACE_SAMPLES", 20_000)
