import pytest

from gsfusion_nb.runs import FinishedRun, run_mapping, scores


@pytest.fixture(autouse=True)
def _few_samples_of_surfaces(monkeypatch):
    """A few thousand are enough for surfaces whose error is centimetres."""
    monkeypatch.setattr(scores, "SURFACE_SAMPLES", 4_000)


@pytest.fixture(scope="session")
def whole_run(config, tmp_path_factory) -> FinishedRun:
    """A run of ``config`` on the frames of ``small_room``, without scores; nothing stopped it. Not
    to be changed."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return run_mapping(
        "room", config, folder=folder, evaluate=False, n_frames=120, width=80, height=60
    )


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
        "tsdf.npz",
        "places.npz",
        "state.zip",
        "report.html",
        ".lock",
    }
