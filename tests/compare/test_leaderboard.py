"""The leaderboard: what it counts, what it survives, and that a stop keeps what has finished."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.entries import Entrant, entries_of
from gsfusion_nb.compare.leaderboard import Leaderboard, LeaderboardRow, compare_rules
from gsfusion_nb.config import gsfusion, replace
from gsfusion_nb.data import open_sequence
from gsfusion_nb.drawing.curves import figure_picture
from gsfusion_nb.mapping import GSFusion

CONFIG = gsfusion(
    "room", data__width=64, data__height=48, data__stop=5, data__hold_out_every=5, tsdf__voxel_size_m=0.05,
    sh_degree=0, optim__global_iterations=0, seeding__quadtree_contrast="std", seeding__quadtree_threshold=0.05,
)  # fmt: skip
QUIET: dict[str, Any] = {"on_progress": lambda progress: None}


@pytest.fixture(scope="module")
def sequence():
    return open_sequence("room", data=CONFIG.data, n_frames=60)


def row(name, psnr_db, n, ms=10.0):
    return LeaderboardRow(
        name=name, psnr_db=psnr_db, ssim=0.5, n_gaussians=n, n_keyframes=3, ms_per_frame=ms, cpu_ms_per_frame=ms,
        seeding_ms=1.0,
    )  # fmt: skip


BOARD = Leaderboard(rows=[row("small", 20.0, 1000), row("good", 25.0, 5000), row("beaten", 24.0, 9000)], complete=True)


def test_the_front_and_the_order_by_hand():
    assert BOARD.front == ["small", "good"]
    assert [r.name for r in BOARD.sorted] == ["good", "beaten", "small"]
    assert BOARD["good"].n_gaussians == 5000
    with pytest.raises(KeyError, match="there are: small, good, beaten"):
        BOARD["best"]


def test_the_table_says_the_numbers_in_text_html_and_markdown():
    for text in (repr(BOARD), BOARD._repr_html_(), BOARD.as_markdown()):
        assert "25.00" in text
        assert "5,000" in text
        assert "● good" in text
        assert "● beaten" not in text
    assert "stopped" not in repr(BOARD)
    assert "stopped" in repr(dataclasses.replace(BOARD, complete=False))
    hostile = Leaderboard(rows=[row("<b>", 1.0, 1)])
    assert "<b></td>" not in hostile._repr_html_()


def test_pictures_even_of_nothing():
    empty, full = (figure_picture(board.figure()) for board in (Leaderboard(), BOARD))
    assert empty.shape == full.shape == (400, 640, 3)
    assert (full != empty).any()
    assert full.dtype == np.uint8


def test_a_run_agrees_with_the_mapper(sequence):
    board = compare_rules(["gsfusion", Entrant("uniform", {"fraction": 0.1})], sequence, CONFIG, **QUIET)
    assert board.complete
    assert "not equal between the rules" in repr(board)
    assert [r.name for r in board.rows] == ["gsfusion", "uniform fraction=0.1"]
    mapper = GSFusion(CONFIG)
    for frame in sequence.mapping:
        mapper.step(frame)
    assert board["gsfusion"].n_gaussians == len(mapper.gaussians)
    assert board["gsfusion"].n_keyframes == len(mapper.keyframes)
    assert all(r.ms_per_frame > 0 and 5 < r.psnr_db < 60 for r in board.rows)


def test_it_repeats_exactly(sequence):
    a, b = (compare_rules(["uniform"], sequence, CONFIG, **QUIET).rows[0] for _ in range(2))
    assert (a.psnr_db, a.n_gaussians, a.key) == (b.psnr_db, b.n_gaussians, b.key)


def test_the_key_of_a_row_is_its_content(sequence):
    def keys(rules, sequence=sequence, config=CONFIG):
        return [e.spec.key for e in entries_of(rules, [sequence], seeds=[config.seed], config=config)]

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


def test_equal_budgets_and_several_seeds(sequence):
    rules = [Entrant("uniform", {"fraction": 0.02}), Entrant("dense", size_option="thin")]
    equal = compare_rules(rules, sequence, CONFIG, budget=Budget(gaussians=200), seeds=2, **QUIET)
    assert not equal.failed
    assert all(abs(r.n_gaussians / 200 - 1) <= 0.05 for r in equal.rows)
    assert len({r.n_steps for r in equal.rows}) == 1
    assert "means over 2 seeds" in repr(equal)
    assert " ± " in equal.as_markdown()
    assert "not equal" not in repr(equal)


def test_a_stop_keeps_what_has_finished_and_can_go_on(sequence):
    seen = []

    def stop_in_the_second(progress):
        seen.append(progress)
        return progress.position == 1

    board = compare_rules(["uniform", "gsfusion"], sequence, CONFIG, on_progress=stop_in_the_second)
    assert [r.name for r in board.rows] == ["uniform"]
    assert not board.complete
    assert all(0 <= p.share <= 1 for p in seen)
    assert str(seen[0]) == "uniform (1 of 2): frame 1 of 4"


def test_ctrl_c_ends_it_between_frames(sequence):
    def interrupt(progress):
        if progress.position == 1:
            raise KeyboardInterrupt

    board = compare_rules(["uniform", "gsfusion"], sequence, CONFIG, on_progress=interrupt)
    assert [r.name for r in board.rows] == ["uniform"]


def test_an_option_that_a_rule_does_not_have_is_refused_before_anything_runs(sequence):
    with pytest.raises(TypeError, match=r"has no options \['fration'\]"):
        compare_rules(["uniform", Entrant("uniform", {"fration": 0.2})], sequence, CONFIG)


def test_a_rule_that_fails_does_not_spoil_the_others(sequence):
    def faulty(ctx):
        raise IndexError("7 is out of range")

    def silent(ctx):
        return None

    rules = [faulty, silent, "uniform"]
    board = compare_rules(rules, sequence, CONFIG, **QUIET)  # pyright: ignore[reportArgumentType]
    assert board.failed["faulty"] == "IndexError: 7 is out of range"
    assert "NoneType" in board.failed["silent"]
    assert [r.name for r in board.rows] == ["uniform"]
    assert board.complete
    assert "faulty did not run" in repr(board)


def test_what_cannot_be_compared_is_refused(sequence):
    with pytest.raises(ValueError, match="rules with different labels, got uniform twice"):
        compare_rules(["uniform", "uniform"], sequence, CONFIG)
    with pytest.raises(ValueError, match="got no rule"):
        compare_rules([], sequence, CONFIG)
    with pytest.raises(KeyError, match="nonsense"):
        compare_rules(["nonsense"], sequence, CONFIG)
    unseen = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, hold_out_every=0))
    with pytest.raises(ValueError, match="hold_out_every"):
        compare_rules(["uniform"], open_sequence("room", data=unseen.data, n_frames=60), unseen)
