import subprocess

import pytest

from gsfusion_nb.cli import doctor
from gsfusion_nb.viz.meshes import can_draw


@pytest.fixture(autouse=True)
def _fresh_probe():
    can_draw.cache_clear()
    yield
    can_draw.cache_clear()


def test_everything_needed_is_found_here(capsys, monkeypatch):
    monkeypatch.setenv("GSNB_VTK", "none")
    assert doctor.main() == 0
    text = capsys.readouterr().out
    assert "render_forward / reference" in text
    assert "Everything needed is installed." in text


def test_a_missing_package_is_named_with_its_remedy(capsys, monkeypatch):
    monkeypatch.setenv("GSNB_VTK", "none")
    real = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "kornia" else real(name))
    assert doctor.main() == 1
    assert "-> pip install kornia" in capsys.readouterr().out


def test_opencv_twins_are_found(monkeypatch):
    monkeypatch.setattr(
        doctor, "_version", lambda name: "5.0" if name.startswith("opencv") else None
    )
    check = doctor._opencv_twins()
    assert not check.ok
    assert "pip uninstall opencv-python" in check.remedy


@pytest.mark.parametrize(
    ("returncode", "stderr", "ok", "why"),
    [(0, "", True, "ok"), (-11, "", False, "apt-get install"), (1, "a\nboom\n", False, "boom")],
)
def test_drawing_is_tried_in_a_process_of_its_own(returncode, stderr, ok, why, monkeypatch):
    """A segmentation fault there is a sentence here."""
    monkeypatch.delenv("GSNB_VTK", raising=False)
    done = subprocess.CompletedProcess([], returncode, "", stderr)
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: done)
    assert can_draw()[0] is ok
    assert why in can_draw()[1]
