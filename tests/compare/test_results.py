"""Rules compared in one call: what is counted, what it survives, and that a stop keeps what has
finished."""

import dataclasses

import pytest

from gsfusion_nb.compare import Budget, compare_rules
from gsfusion_nb.compare.entries import Entrant, entries_of
from gsfusion_nb.config import gsfusion, replace
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import GSFusion

CONFIG = gsfusion(
    "room",
    data__width=64,
    data__height=48,
    data__stop=5,
    data__hold_out_every=5,
    tsdf__voxel_size_m=0.05,
    sh_degree=0,
    optim__global_iterations=0,
    seeding__quadtree_contrast="std",
    seeding__quadtree_threshold=0.05,
)


@pytest.fixture(scope="module")
def sequence():
    return open_sequence("room", data=CONFIG.data, n_frames=60)


def test_a_run_agrees_with_the_mapper_and_is_shown(sequence):
    board = compare_rules(["gsfusion", Entrant("uniform", {"fraction": 0.1})], sequence, CONFIG)
    assert [g.label for g in board.groups] == ["gsfusion", "uniform fraction=0.1"]
    mapper = GSFusion(CONFIG)
    for frame in sequence.mapping:
        mapper.step(frame)
    (run,) = board["gsfusion"]
    assert run.metrics["n_gaussians"] == len(mapper.gaussians)
    assert run.metrics["n_keyframes"] == len(mapper.keyframes)
    for text in (repr(board), board._repr_html_()):
        assert f"{len(mapper.gaussians):,}" in text
        assert "not equal between the rules" in text
    with pytest.raises(KeyError, match="best"):
        board["best"]


def test_the_key_of_a_run_is_its_content(sequence):
    def keys(rules, sequence=sequence, config=CONFIG):
        return [
            e.spec.key
            for e in entries_of(
                rules,
                [sequence],
                seeds=[config.seed],
                config=config,
            )
        ]

    def mine(ctx):
        return ctx.cells()

    def edited(ctx):
        return ctx.cells()[::2]

    edited.__name__ = "mine"
    base = keys(["uniform", mine])
    assert base == keys(["uniform", mine])
    others = [
        *keys([Entrant("uniform", {"fraction": 0.2}), edited]),
        *keys(["uniform", mine], config=replace(CONFIG, seed=1)),
        *keys(["uniform", mine], open_sequence("room", data=CONFIG.data, n_frames=90)),
    ]
    assert len({*base, *others}) == 8


@pytest.mark.ci
def test_equal_budgets_and_several_seeds(sequence):
    rules = [Entrant("uniform", {"fraction": 0.02}), Entrant("dense", size_option="thin")]
    equal = compare_rules(rules, sequence, CONFIG, budget=Budget(gaussians=200), seeds=2)
    assert not any(g.failed for g in equal.groups)
    assert all(abs(g.summary("n_gaussians").mean / 200 - 1) <= 0.05 for g in equal.groups)
    assert len({g.summary("n_steps").mean for g in equal.groups}) == 1
    assert " ± " in repr(equal)
    assert "not equal" not in repr(equal)


def test_ctrl_c_keeps_what_has_finished(sequence):
    def interrupted(ctx):
        raise KeyboardInterrupt

    board = compare_rules([Entrant("uniform", {"fraction": 0.4}), interrupted], sequence, CONFIG)
    assert [g.label for g in board.groups] == ["uniform fraction=0.4"]


def test_a_rule_that_fails_does_not_spoil_the_others(sequence):
    def faulty(ctx):
        raise IndexError("7 is out of range")

    def silent(ctx):
        return None

    rules = [faulty, silent, "uniform"]
    board = compare_rules(rules, sequence, CONFIG)  # pyright: ignore[reportArgumentType]
    assert board["faulty"] == board["silent"] == []
    assert board["uniform"]
    assert "IndexError: 7 is out of range" in repr(board)
    assert "faulty did not run" in repr(board)


def test_what_cannot_be_compared_is_refused_before_anything_runs(sequence):
    with pytest.raises(TypeError, match="fration"):
        compare_rules(["uniform", Entrant("uniform", {"fration": 0.2})], sequence, CONFIG)
    with pytest.raises(ValueError, match="uniform twice"):
        compare_rules(["uniform", "uniform"], sequence, CONFIG)
    with pytest.raises(ValueError, match="no rule"):
        compare_rules([], sequence, CONFIG)
    with pytest.raises(KeyError, match="nonsense"):
        compare_rules(["nonsense"], sequence, CONFIG)
    unseen = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, hold_out_every=0))
    with pytest.raises(ValueError, match="hold_out_every"):
        compare_rules(["uniform"], open_sequence("room", data=unseen.data, n_frames=60), unseen)
