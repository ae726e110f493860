"""A run with a class rule: its memory goes through a checkpoint on disk, and the settings that it
brings are stored."""

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from gsfusion_nb.config import gsfusion, to_dict
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun, rescore, run_mapping, scores
from gsfusion_nb.runs.checkpoint import save_checkpoint
from gsfusion_nb.runs.map_hashes import hash_of
from gsfusion_nb.runs.resume import load_run
from gsfusion_nb.seeding import MapRule, SeedContext, Seeds, When, every

ROOM: dict[str, Any] = {"n_frames": 120, "width": 48, "height": 36}
SETTINGS = gsfusion(
    "online",
    data__stop=5,
    data__hold_out_every=4,
    data__hold_out_offset=2,
    tsdf__voxel_size_m=0.1,
    sh_degree=0,
)


@dataclass(frozen=True, kw_only=True)
class thinning(MapRule):
    """A random share of the pixels, smaller with each call; it keeps what it drew."""

    share: float = 0.3
    when: ClassVar[When] = every(2)
    overrides: ClassVar[Mapping[str, Any]] = {"optim__depth_weight": 0.5, "keyframe_every": 2}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """Fewer each time."""
        calls = memory["calls"] = memory.get("calls", 0) + 1
        memory["drawn"] = torch.rand(len(ctx.pixels()), generator=ctx.generator)
        memory["kinds"] = (None, True, "word", [1.5, {"deep": torch.ones(2, dtype=torch.int32)}])
        return ctx.seeds_at(ctx.pixels()[memory["drawn"] < self.share / calls], 1.0)


def new_run() -> MappingRun:
    source = {"path_or_name": "room", **ROOM}
    return MappingRun(
        open_sequence(**source, data=SETTINGS.data),
        make_mapper(SETTINGS, seeding=thinning),
        source=source,
    )


def test_a_run_continues_from_disk_with_the_memory_of_its_rule(tmp_path):
    whole = new_run()
    half = new_run()
    list(whole.online())
    list(itertools.islice(half.online(), 2))
    save_checkpoint(half, tmp_path)
    resumed = load_run(tmp_path, seeding=thinning)
    memory = resumed.mapper.rule_in_use.memory
    assert memory["kinds"][:3] == (None, True, "word")
    assert memory["kinds"][3][1]["deep"].dtype == torch.int32
    assert torch.equal(memory["drawn"], half.mapper.rule_in_use.memory["drawn"])
    assert resumed.mapper.config == whole.mapper.config
    list(resumed.online())
    hashes = [hash_of(vars(run.mapper.gaussians.params)) for run in (whole, resumed)]
    assert hashes[0] == hashes[1]
    assert (
        resumed.mapper.rule_in_use.memory["calls"] == whole.mapper.rule_in_use.memory["calls"] == 2
    )
    with pytest.raises(
        ValueError, match=r"the seeding rule 'thinning' of this run is not known here; .* rule\.py"
    ):
        load_run(tmp_path)


def test_settings_of_the_rule_are_stored_and_the_report_names_it(tmp_path, monkeypatch):
    # the room's true surface takes long
    monkeypatch.setattr(scores, "score_mesh", lambda run, mesh: {})
    finished = run_mapping("room", SETTINGS, seeding=thinning, folder=tmp_path / "out", **ROOM)
    stored = json.loads((finished.folder / "config.json").read_text())["config"]
    assert stored == json.loads(json.dumps(to_dict(finished.mapper.config)))
    assert (stored["optim"]["depth_weight"], stored["keyframe_every"]) == (0.5, 2)
    assert "class thinning(MapRule):" in (finished.folder / "rule.py").read_text()
    assert "rule thinning" in (finished.folder / "report.html").read_text()
    before = {name: value for name, value in finished.metrics.items() if name.startswith("psnr")}
    assert {
        name: value for name, value in rescore(finished.folder).items() if name in before
    } == before
    frames = json.loads((finished.folder / "metrics.json").read_text())["frames"]
    assert [frame["n_steps"] > 0 for frame in frames] == [True] * 4
