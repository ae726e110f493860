"""The maps by which another version of the program is compared: which there are, and that a change
shows."""

from typing import Any

import pytest
import same_maps

from gsfusion_nb.compare import map_scene
from gsfusion_nb.compare.schedule import with_settings
from gsfusion_nb.mapping.systems import SYSTEMS
from gsfusion_nb.seeding import rule as rule_registry
from gsfusion_nb.seeding.rule import registered
from gsfusion_nb.types import Seeds


def test_every_system_fidelity_and_rule_takes_part():
    names = [name for name, *_ in same_maps.cases()]
    assert len(set(names)) == len(names)
    for system, mapper in SYSTEMS.items():
        assert {f"{system} {f}" for f in mapper.description.fidelities} <= set(names)
    assert {f"rule {rule}" for rule in registered()} <= set(names)
    assert "gsfusion optim__adam_steps=shared" in names
    assert "rtg_slam window__only_unstable=False" in names
    assert "gps_slam base__resolution=full" in names


def test_names_of_maps_that_differ_or_are_gone():
    assert same_maps.differences({"a": "1", "b": "2"}, {"a": "1", "b": "2", "c": "3"}) == []
    assert same_maps.differences({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "0"}) == ["b", "c"]


@pytest.mark.ci
def test_a_changed_rule_changes_its_hash_alone(monkeypatch):
    small = ("gsfusion", "measured", {"seeding__rule": "uniform", "sh_degree": 0})
    other = ("gsfusion", "measured", {"seeding__rule": "dense", "sh_degree": 0})
    before = same_maps.hash_of_map(*small), same_maps.hash_of_map(*other)
    assert before == (same_maps.hash_of_map(*small), same_maps.hash_of_map(*other))
    rule: Any = registered()["uniform"]

    def smaller(ctx, **options) -> Seeds:
        seeds = rule(ctx, **options)
        return seeds[: len(seeds) - 1]

    monkeypatch.setitem(rule_registry._RULES, "uniform", smaller)
    assert same_maps.hash_of_map(*small) != before[0]
    assert same_maps.hash_of_map(*other) == before[1]


@pytest.mark.ci
def test_a_change_in_how_the_lab_maps_changes_its_rows_alone(monkeypatch):
    small = ("gsfusion", "measured", {"seeding__rule": "uniform", "sh_degree": 0})
    before = same_maps.hash_of_map(*small), same_maps.hash_of_row("uniform")
    assert before[1] == same_maps.hash_of_row("uniform")
    pace = map_scene._with_pace

    def slower(config, sequence):
        return with_settings(pace(config, sequence), {"optim.frame_iterations": 2})

    monkeypatch.setattr(map_scene, "_with_pace", slower)
    assert same_maps.hash_of_map(*small) == before[0]
    assert same_maps.hash_of_row("uniform") != before[1]


def test_the_version_of_another_folder_is_not_taken_for_it(tmp_path):
    same_maps.check_imported(same_maps.ROOT)
    with pytest.raises(RuntimeError, match="expected gsfusion_nb of the version in"):
        same_maps.check_imported(tmp_path)
