"""The page "A system of your own in an hour": its class maps as it says, and goes on to the same
map after an interruption."""

import json
import re
from pathlib import Path

import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.mapping import get_system, systems
from gsfusion_nb.runs import resume_mapping, run_mapping
from gsfusion_nb.runs.system_of_run import code_of_system

PAGE = Path(__file__).resolve().parents[2] / "docs/own_system.md"
SMALL = {"data__width": 48, "data__height": 36, "data__stop": 5}


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """The file of the page in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    page = PAGE.read_text(encoding="utf-8")
    block = re.search(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert block is not None
    Path("mine.py").write_text(block.group(1), encoding="utf-8")
    return "mine.py:Mine"


def test_its_class_maps_and_goes_on_to_the_same_map(mine, monkeypatch):
    typed = ["map", "room", "--system", mine, "--data.width", "48", "--data.height", "36"]
    assert main([*typed, "--data.stop", "5", "--reader", "n_frames=480", "--out", "whole"]) == 0
    whole = json.loads(Path("whole/metrics.json").read_text())
    assert whole["metrics"]["psnr_mapped_db"] > 12
    system = get_system(mine)
    config = system.preset("room", **SMALL)
    code_of_system(system(config))
    original = system.map_frame

    def stops(self, frame):
        if frame.index == 3:
            raise KeyboardInterrupt
        return original(self, frame)

    with monkeypatch.context() as patch:
        patch.setattr(system, "map_frame", stops)
        with pytest.raises(KeyboardInterrupt):
            run_mapping("room", config, folder="half", evaluate=False, n_frames=480)
    run = resume_mapping("half", system="half/system.py:Mine", evaluate=False)
    assert json.loads((run.folder / "metrics.json").read_text())["sha256"] == whole["sha256"]
