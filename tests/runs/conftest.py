import pytest

from gsfusion_nb.runs import outputs


@pytest.fixture(autouse=True)
def _few_samples_of_surfaces(monkeypatch):
    """A tenth is enough for surfaces whose error is centimetres."""
    monkeypatch.setattr(outputs, "SURFACE_SAMPLES", 20_000)


@pytest.fixture
def run_files() -> set[str]:
    """The files in the folder of a run that is complete."""
    return {
        "gaussians.ply",
        "mesh.ply",
        "trajectory.txt",
        "config.json",
        "metrics.json",
        "views.json",
        "report.html",
        "status.json",
    }
