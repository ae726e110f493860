"""Rules that are classes: how they are written, their options, when they are asked, and what they
remember."""

import linecache
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import pytest
import torch

from gsfusion_nb.code_keys import rule_fingerprint
from gsfusion_nb.seeding import (
    EVERY_FRAME,
    KEYFRAMES,
    MapRule,
    SeedContext,
    Seeds,
    apply_rule,
    check_contexts,
    check_memory,
    copy_memory,
    every,
    get_rule,
    is_map_rule,
    rule_choices,
    rule_name,
    rule_options,
    rule_source,
    seeding_rule,
    submaps,
)


@pytest.fixture(scope="module")
def ctx() -> SeedContext:
    return check_contexts()["odd"]


@dataclass(frozen=True, kw_only=True)
class Thinning(MapRule):
    """Every n-th cell, fewer with each call."""

    first: int = 1
    side: Literal["all", "none"] = "all"

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """Fewer with each call."""
        memory["calls"] = memory.get("calls", self.first - 1) + 1
        return ctx.cells()[:: memory["calls"]] if self.side == "all" else Seeds.empty()


def test_a_class_is_registered_by_its_name_and_its_fields_are_its_options():
    assert seeding_rule(Thinning) is Thinning is get_rule("Thinning")
    assert is_map_rule(Thinning)
    assert not is_map_rule(get_rule("gsfusion"))
    assert rule_name(Thinning) == "Thinning"
    assert rule_options("Thinning") == {"first": 1, "side": "all"}
    assert rule_choices(Thinning) == {"side": ("all", "none")}
    assert "Every n-th cell" in rule_source(Thinning)


@pytest.mark.parametrize(
    ("when", "due", "starts"),
    [
        (EVERY_FRAME, [0, 1, 2, 3, 4, 5, 6, 7, 8], [0]),
        (every(3), [0, 3, 6], [0]),
        (submaps(4), [0, 4, 8], [0, 4, 8]),
        (every(3, submap_frames=4), [0, 3, 4, 7, 8], [0, 4, 8]),
        (KEYFRAMES, [0, 5], [0]),
    ],
)
def test_when_a_rule_is_due(when, due, starts):
    assert [n for n in range(9) if when.is_due(n, n % 5 == 0)] == due
    assert [n for n in range(9) if when.starts_submap(n)] == starts


def test_memory_holds_what_a_checkpoint_can_save(ctx):
    memory = {
        "seen": torch.zeros(2, 3),
        "n": 3,
        "deep": {"list": [1.5, None, "x", (True, torch.ones(1))]},
    }
    check_memory("mine", memory)
    copied = copy_memory(memory)
    memory["seen"] += 1
    memory["deep"]["list"].append(2)
    assert copied["seen"].sum() == 0
    assert len(copied["deep"]["list"]) == 4
    assert isinstance(copied["deep"]["list"][3], tuple)
    with pytest.raises(
        TypeError,
        match=r"'mine' keeps a set in its memory\['deep'\]\['s'\], which a checkpoint cannot",
    ):
        check_memory("mine", {"deep": {"s": {1}}})
    with pytest.raises(TypeError, match="'mine': the keys of its memory must be words, got 1"):
        check_memory("mine", {1: 2})

    def hoards(ctx: SeedContext) -> Seeds:
        ctx.memory["frame"] = ctx.frame
        return ctx.cells()

    with pytest.raises(TypeError, match=r"'hoards' keeps a Frame in its memory\['frame'\]"):
        apply_rule(hoards, ctx)
    ctx.memory.clear()


CELL = """
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class of_a_cell(MapRule):
    n: int = {n}
    when: ClassVar[When] = every({when})
    overrides: ClassVar[Mapping] = {{"optim__lr_xyz": 1.0}}

    def __post_init__(self):
        assert self.n > {least}

    def seeds(self, ctx, memory):
        return helper(ctx.cells(), self.n)

def helper(seeds, n):
    return seeds[::n]
"""


def run_cell(**values) -> Any:
    """The class that a notebook cell defines: a module without a file, whose lines only linecache
    knows."""
    name = "<ipython-input-7>"
    text = CELL.format(**{"n": 1, "when": 1, "least": 0} | values)
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    space = {
        "__name__": "__main__",
        **{k: globals()[k] for k in ("seeding_rule", "dataclass", "MapRule", "every")},
    }
    exec(
        compile(text, name, "exec"),
        space | {"ClassVar": ClassVar, "When": type(every(1)), "Mapping": Mapping},
        space,
    )
    return space["of_a_cell"]


def test_the_fingerprint_of_a_class_sees_options_checks_and_when():
    first = rule_fingerprint(run_cell())
    assert rule_fingerprint(run_cell()) == first
    changed = [
        rule_fingerprint(run_cell(**change)) for change in ({"n": 2}, {"when": 2}, {"least": -1})
    ]
    assert len({first, *changed}) == 4


@pytest.mark.parametrize(
    ("when", "stride", "due", "starts"),
    [
        (every(30), 6, [0, 5, 10], [0]),
        (every(30), 7, [0, 5, 9], [0]),  # frames 0, 35 and 63: the first at or after 0, 30 and 60
        (every(5), 6, list(range(11)), [0]),
        (every(30), 42, list(range(11)), [0]),
        (submaps(50), 6, [0, 9], [0, 9]),  # frame 54 is the first after 50
        (every(30, submap_frames=50), 10, [0, 3, 5, 8, 10], [0, 5, 10]),
    ],
)
def test_intervals_count_frames_of_the_recording(when, stride, due, starts):
    assert [n for n in range(11) if when.is_due(n, None, stride=stride)] == due
    assert [n for n in range(11) if when.starts_submap(n, stride=stride)] == starts


def test_a_class_is_asked_with_its_options_and_the_memory_of_the_context(ctx):
    n = len(ctx.cells())
    ctx.memory.clear()
    sizes = [len(apply_rule(Thinning, ctx, {"first": 2})) for _ in range(2)]
    assert sizes == [-(-n // 2), -(-n // 3)]
    assert ctx.memory == {"calls": 3}
    with pytest.raises(
        TypeError, match=r"'Thinning' has no options \['last'\]; known: \['first', 'side'\]"
    ):
        apply_rule(Thinning, ctx, {"last": 2})
    ctx.memory.clear()


@pytest.mark.parametrize(
    "memory",
    [
        {"xyz_W": torch.zeros(3, 3)},
        {"at": {"xyz_W": torch.zeros(3, 3), "frame_index": torch.zeros(2, dtype=torch.int64)}},
        {"T_WC": torch.eye(4), "frame_index": torch.zeros(1, dtype=torch.int64)},
        {"normal_W": torch.zeros(1, 3), "frame_index": 0},
    ],
)
def test_values_in_world_coordinates_need_the_frame_of_each_row(memory):
    with pytest.raises(TypeError, match=r"'Walker'.*frame_index"):
        check_memory("Walker", memory)
