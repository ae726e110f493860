"""What installed packages add by entry points: systems, rules and readers are known by their names
and loaded only when they are asked for."""

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from toy_system import SOURCE, write_toy

from gsfusion_nb.code_keys import code_key, installed
from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.open import known_layouts
from gsfusion_nb.extensions import extensions, warn_once
from gsfusion_nb.mapping import get_system, package_of, system_names, system_of, systems
from gsfusion_nb.runs import rescore, run_mapping
from gsfusion_nb.seeding import get_rule, registered
from gsfusion_nb.seeding.rule import keep_registered

RULE = """
from gsfusion_nb.seeding import seeding_rule

@seeding_rule
def box_rule(ctx, *, step: int = 9):
    return ctx.seeds_at(ctx.pixels()[::step], 1.0)

@seeding_rule
def uniform(ctx):
    return None
"""
READER = """
import numpy as np
import torch

from gsfusion_nb.data.recorded.recorded_sequence import Layout
from gsfusion_nb.types import Camera, Frame


class Walls:
    name = "walls"
    camera = Camera(width=48, height=36, fx=40.0, fy=40.0, cx=24.0, cy=18.0)

    def __init__(self, path):
        self.depth_m = np.load(path / "walls.npz")["depth_m"]

    def __len__(self):
        return len(self.depth_m)

    def __getitem__(self, i):
        if i >= len(self):
            raise IndexError(i)
        depth_m = torch.full((36, 48), float(self.depth_m[i]))
        return Frame(index=i, timestamp_s=i / 30, rgb=torch.rand(36, 48, 3), depth_m=depth_m,
                     camera=self.camera, T_WC=self.pose(i))

    def pose(self, i):
        return torch.eye(4)


LAYOUT = Layout(read=Walls, looks_for=("walls.npz",))
NO_LAYOUT = 3
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """``install(name, points, **modules)``: a package as pip leaves it, on Python's path."""
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    monkeypatch.setattr(systems, "_REGISTERED", dict(systems._REGISTERED))
    modules = set(sys.modules)

    def make(name: str, points: str, **sources: str) -> Path:
        place = tmp_path / name / "site-packages"
        about = place / f"{name.replace('-', '_')}-1.0.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(points)
        for module, source in sources.items():
            (place / f"{module}.py").write_text(source)
        (about / "RECORD").write_text("".join(f"{module}.py,,\n" for module in sources))
        monkeypatch.syspath_prepend(str(place))
        installed._records.cache_clear()
        installed.distribution_of.cache_clear()
        return place

    warn_once.cache_clear()
    with keep_registered():
        yield make
    for module in set(sys.modules) - modules:
        del sys.modules[module]
    installed._records.cache_clear()
    installed.distribution_of.cache_clear()


def test_a_system_of_a_package(install, tmp_path):
    place = install("egg-box", "[gsfusion_nb.systems]\negg = egg_box:Toy\n", egg_box=SOURCE)
    write_toy(place)
    assert "egg" in system_names()
    assert "egg_box" not in sys.modules
    system = get_system("egg")
    assert get_system("egg") is system
    assert (system_of(system.preset("room")), package_of("egg")) == ("egg", "egg-box 1.0")
    config = system.preset("room", data__width=48, data__height=36, data__stop=10)
    run = run_mapping("room", config, folder=tmp_path / "run", evaluate=False, n_frames=60)
    assert not (run.folder / "system.py").exists()
    assert '"system": "egg"' in (run.folder / "config.json").read_text()
    assert rescore(run.folder)["psnr_mapped_db"] > 5


def test_a_rule_of_a_package(install):
    built_in = registered()["uniform"]
    install("rules-box", "[gsfusion_nb.rules]\nbox_rule = rules_box:box_rule\n", rules_box=RULE)
    assert "rules_box" not in sys.modules
    with pytest.raises(KeyError, match=r"no seeding rule 'box_rul'; known: .*box_rule"):
        get_rule("box_rul")
    rule = get_rule("box_rule")
    assert registered()["box_rule"] is rule
    assert registered()["uniform"] is built_in
    assert code_key(rule).parts["package rules-box"] == "1.0"


def test_a_reader_of_a_package(install, tmp_path):
    install("walls-box", "[gsfusion_nb.readers]\nwalls = walls_box:LAYOUT\n", walls_box=READER)
    folder = tmp_path / "data"
    folder.mkdir()
    np.savez(folder / "walls.npz", depth_m=[1.0, 2.0])
    assert list(known_layouts())[-1] == "walls"
    assert float(open_sequence(folder).source[1].depth_m.mean()) == 2.0
    assert len(open_sequence(folder, format="walls").mapping) == 2


def test_what_cannot_be_loaded_is_said_and_harms_nothing_else(install, caplog):
    install(
        "bad-box",
        "[gsfusion_nb.readers]\nthree = bad_box:NO_LAYOUT\ngone = bad_box:NOTHING\n"
        "[gsfusion_nb.rules]\nother_name = rule_box:box_rule\n"
        "[gsfusion_nb.systems]\nbroken = broken_box:Toy\nnone = bad_box:NO_LAYOUT\n",
        bad_box=READER,
        broken_box="x = 1 / 0\n",
        rule_box=RULE,
    )
    with caplog.at_level(logging.WARNING):
        assert not {"three", "gone"} & set(known_layouts())
    assert "expected a Layout, got 3: the reader 'three' of the package bad-box 1.0" in caplog.text
    assert "the reader 'gone' of the package bad-box 1.0 (bad_box:NOTHING) cannot" in caplog.text
    with pytest.raises(ValueError, match="expected a seeding rule called 'other_name', got"):
        get_rule("other_name")
    with pytest.raises(ValueError, match=r"system 'broken' of .* cannot be loaded: ZeroDivision"):
        get_system("broken")
    with pytest.raises(TypeError, match=r"'none' of the package bad-box 1.0 .*: expected a class"):
        get_system("none")


def test_a_name_that_is_taken_is_not_used(install, caplog):
    install("one-box", "[gsfusion_nb.systems]\ngsfusion = one_box:Toy\negg = one_box:Toy\n")
    with caplog.at_level(logging.WARNING):
        assert system_names() == ["gsfusion", "rtg_slam", "gps_slam", "egg"]
        install("two-box", "[gsfusion_nb.systems]\negg = two_box:Toy\n")
        assert "egg" not in extensions("systems")
        assert "egg" not in system_names()
    assert "one-box 1.0 (one_box:Toy) is not used: gsfusion_nb itself has one" in caplog.text
    assert "two-box 1.0 and one-box 1.0 have that name; remove one" in caplog.text
