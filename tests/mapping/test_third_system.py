"""A third system is a file in ``mapping/``, one in ``config/`` and a line in ``systems.py``: a toy system in a copy."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

CONFIG = '''
"""Settings of the toy system."""

from dataclasses import dataclass, field
from typing import Any

from ..checks import check_name
from .parts import TsdfConfig
from .system import SystemConfig
from .values import from_dict, replace


@dataclass(frozen=True, kw_only=True)
class ToyConfig(SystemConfig):
    """TSDF fusion, and one Gaussian per frame."""

    tsdf: TsdfConfig = field(default_factory=lambda: TsdfConfig(voxel_size_m=0.05))
    size_m: float = 0.2
    """Standard deviation of the Gaussians, metres."""


PRESETS: dict[str, dict[str, Any]] = {"replica": {}, "room": {"data": {"width": 80, "height": 60}}}


def toy(preset: str = "replica", **overrides: Any) -> ToyConfig:
    check_name("preset", preset, PRESETS)
    return replace(from_dict(ToyConfig, PRESETS[preset]), **overrides)
'''

MAPPER = '''
"""The toy system."""

import torch

from ..config.toy import ToyConfig, toy
from ..tracking import tsdf_surface
from ..tsdf import TsdfVolume, extract_mesh, integrate, raycast
from ..types import Seeds
from .frame_checks import check_frame
from .mapper import Mapper
from .step_report import StageClock, StepReport


class Toy(Mapper):
    title = "Toy"
    config_type = ToyConfig
    preset = staticmethod(toy)
    n_passes = 1

    def __init__(self, config=None, *, seeding=None, device="cpu"):
        super().__init__(config, seeding=seeding, device=device)
        self.volume = TsdfVolume(self.config.tsdf, device=self.device)

    def step(self, frame):
        frame, clock = check_frame(frame, self.device), StageClock()
        with clock("tracking"):
            frame = self.localiser.locate(frame, tsdf_surface(self.volume))
        with clock("tsdf"):
            integrate(self.volume, frame)
        middle = self.seed_context(frame)
        at = torch.tensor([[frame.camera.width / 2, frame.camera.height / 2]])
        seeds: Seeds = middle.seeds_at(at, self.config.size_m * frame.camera.fx)
        self.gaussians.append(seeds, frame.index)
        self.keyframes.append(frame)
        self._follow(self.localiser.record(frame))
        self.n_frames += 1
        return StepReport(
            frame_index=frame.index, n_seeds=len(seeds), n_gaussians=len(self.gaussians), is_keyframe=True, losses=(),
            tracking=self.localiser.report, seconds=clock.seconds,
        )

    def surface(self, camera, T_WC):
        return raycast(self.volume, camera, T_WC.to(self.device))

    def mesh(self):
        return extract_mesh(self.volume)

    def state_dict(self):
        return super().state_dict() | {"volume": self.volume.state_dict()}

    def _load(self, state):
        super()._load(state)
        self.volume.load_state_dict(state["volume"])

    def _global_step(self, i):
        return torch.tensor(0.5)
'''

USE = """
import json
import sys
from pathlib import Path

import torch

torch.set_num_threads(1)
import gsfusion_nb
from gsfusion_nb.cli import main
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import SYSTEMS, get_system, make_mapper, system_of
from gsfusion_nb.runs import MappingRun, resume_mapping
from gsfusion_nb.runs.run_warnings import describe_full
from gsfusion_nb.viz import LiveMapper, SplatViewer

out = Path(sys.argv[1])
assert Path(gsfusion_nb.__file__).is_relative_to(out), gsfusion_nb.__file__
assert list(SYSTEMS) == ["gsfusion", "rtg_slam", "toy", "gps_slam"]

# the command line: map, its settings, its report, and scoring again
options = "--data.stop 6 --data.hold-out-every 3 --data.hold-out-offset 1 --size-m 0.1 --system toy".split()
assert main(["map", "room", *options, "--reader", "n_frames=120", "--out", str(out / "run")]) == 0
made = {p.name for p in (out / "run").iterdir()}
assert made >= {"gaussians.ply", "mesh.ply", "trajectory.txt", "config.json", "metrics.json", "report.html"}, made
assert "Toy on room" in (out / "run" / "report.html").read_text()
settings = json.loads((out / "run" / "config.json").read_text())
assert (settings["system"], settings["config"]["size_m"], settings["config"]["data"]["width"]) == ("toy", 0.1, 80)
document = json.loads((out / "run" / "metrics.json").read_text())
assert document["status"] == "complete" and document["metrics"]["n_gaussians"] == 4, document["metrics"]
assert main(["eval", str(out / "run")]) == 0
again = ["map", "room", "--from-config", str(out / "run" / "config.json"), "--no-evaluate", "--out", str(out / "again")]
assert main([*again, "--reader", "n_frames=120"]) == 0

# a checkpoint, and going on from it, with tracked poses
config = get_system("toy").preset("room", data__stop=6, data__hold_out_every=0, tracking__poses="tracked")
assert system_of(config) == "toy"
source = {"path_or_name": "room", "n_frames": 480}
run = MappingRun(open_sequence(**source, data=config.data), make_mapper(config), source=source)
frames = run.online()
for _ in range(3):
    next(frames)
frames.close()
(out / "broken_off").mkdir()
run.save_checkpoint(out / "broken_off")
resumed = resume_mapping(out / "broken_off", evaluate=False)
assert resumed.metrics["n_frames"] == 6 and resumed.mapper.volume.n_blocks > run.mapper.volume.n_blocks > 0
assert type(resumed.mapper).__name__ == "Toy"

# live panels and curves, the orbit, and the words for a full memory
live = LiveMapper(run)
assert live.run_sync(2) == 2
live.picture()
assert list(live.panels.pictures) == ["input", "render", "error", "new_gaussians"]
assert SplatViewer(run.mapper).picture().any()
assert "5 Gaussians" in describe_full(run.mapper)
print("the toy system works")
"""


@pytest.mark.ci
def test_a_toy_system_runs_from_first_frame_to_report(tmp_path):
    copy = tmp_path / "gsfusion_nb"
    shutil.copytree(ROOT / "gsfusion_nb", copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "kernels").symlink_to(ROOT / "kernels")
    (copy / "config" / "toy.py").write_text(CONFIG)
    (copy / "mapping" / "toy.py").write_text(MAPPER)
    table = (copy / "mapping" / "systems.py").read_text()
    entry = '    "rtg_slam": RTGSLAM,\n'
    assert table.count(entry) == 1
    table = table.replace(entry, f'{entry}    "toy": Toy,\n')
    (copy / "mapping" / "systems.py").write_text(
        table.replace("from .rtg_slam", "from .toy import Toy\nfrom .rtg_slam")
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", USE, str(tmp_path)], capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "the toy system works" in done.stdout
