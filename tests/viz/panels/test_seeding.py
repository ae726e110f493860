"""The quadtree's views; sliders from a rule's keywords, and the picture of its seeds."""

from typing import Literal

import numpy as np
import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.seeding import Seeds, quadtree, registered, rule_options
from gsfusion_nb.viz.panels.panel import Choice, Slider, Switch
from gsfusion_nb.viz.panels.quadtree import QUADTREE_SHOWS, cell_means, quadtree_picture
from gsfusion_nb.viz.panels.rule_table import rule_table
from gsfusion_nb.viz.panels.seeding import rule_context, rule_controls, rule_panel, rule_picture


@pytest.fixture
def photo():
    """Left half one colour, right half noise."""
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    rgb[:, :32] = (40, 90, 160)
    return rgb


def test_cells_are_filled_with_their_mean(photo):
    cells = quadtree(torch.from_numpy(photo), threshold=0.02)
    means = cell_means(torch.from_numpy(photo), cells).numpy()
    for x, y, w, h in zip(
        *(c.tolist() for c in (cells.x0, cells.y0, cells.width, cells.height)),
        strict=True,
    ):
        expected = photo[y : y + h, x : x + w].reshape(-1, 3).mean(0).round()
        assert (means[y : y + h, x : x + w] == expected).all()


def test_every_view_draws_the_same_cells(photo):
    pictures = {}
    for show in QUADTREE_SHOWS:
        pictures[show], cells = quadtree_picture(photo, threshold=0.02, show=show, scale=2)
        assert len(cells) == len(quadtree(torch.from_numpy(photo), threshold=0.02))
        assert pictures[show].shape == (96, 128, 3)
    assert len({p.tobytes() for p in pictures.values()}) == 3
    assert (pictures["mean colours"][10:80, 4:40] == (40, 90, 160)).all()
    assert (pictures["Gaussians"][10:80, 10:40] == (40, 90, 160)).mean() > 0.99
    with pytest.raises(ValueError, match="show must be one of cells"):
        quadtree_picture(photo, show="dots")  # pyright: ignore[reportArgumentType]


CONFIG = gsfusion("room", tsdf__voxel_size_m=0.04)


def every_kind(
    ctx,
    *,
    share: float = 0.1,
    count: int = 8,
    offset: float = 0.0,
    on: bool = True,
    word: Literal["a", "b"] = "a",
) -> Seeds:
    return ctx.cells()


@pytest.fixture(scope="module")
def scenes():
    sequence = open_sequence("room", data=CONFIG.data, n_frames=60)
    mapper = GSFusion(CONFIG)
    fresh = rule_context(mapper, sequence.mapping[0])
    for i in range(2):
        mapper.step(sequence.mapping[i])
    return {"first": fresh, "later": rule_context(mapper, sequence.mapping[4])}, mapper


def test_a_control_for_each_option():
    controls = rule_controls(every_kind, {"count": (2, 20)})
    share, count, offset, word = (controls[name] for name in ("share", "count", "offset", "word"))
    assert isinstance(share, Slider)
    assert share.log
    assert (share.low, share.high) == pytest.approx((0.005, 2.0))
    assert isinstance(count, Slider)
    assert (count.low, count.high, count.step) == (2, 20, 1)
    assert isinstance(offset, Slider)
    assert (offset.low, offset.high) == (-1, 1)
    for limits, step in (((0, 5), 1.0), ((0.0, 5.0), 0.05)):
        share = rule_controls(every_kind, {"share": limits})["share"]
        assert isinstance(share, Slider)
        assert (share.low, share.high, share.step) == (*limits, step)
    assert isinstance(controls["on"], Switch)
    assert isinstance(word, Choice)
    assert list(word.options) == ["a", "b"]
    with pytest.raises(KeyError, match="no options \\['speed'\\]"):
        rule_controls(every_kind, {"speed": (0, 1)})


@pytest.mark.parametrize("rule", list(registered()))
def test_every_registered_rule_has_a_panel_that_agrees_with_it(rule, scenes):
    contexts, _ = scenes
    panel = rule_panel(rule, contexts)
    assert set(rule_options(rule)) | {"scene", "show"} == set(panel.controls)
    _, seeds = rule_picture(rule, contexts["first"])
    assert f">{len(seeds):,}</b>" in panel.caption.value
    before = panel.picture().copy()
    assert (panel.set(scene="later").picture() != before).any()


def test_looking_at_a_frame_leaves_the_mapper_alone(scenes):
    _, mapper = scenes
    before = (len(mapper.gaussians), mapper.volume.n_blocks, mapper.n_frames)
    sequence = open_sequence("room", data=CONFIG.data, n_frames=60)
    ctx = rule_context(mapper, sequence.mapping[4])
    mapped = len(mapper.propose_seeds(mapper.seed_context(sequence.mapping[4])))
    assert (len(mapper.gaussians), mapper.volume.n_blocks, mapper.n_frames) == before
    _, seeds = rule_picture("gsfusion", ctx)
    assert len(seeds) > mapped  # the context's volume has taken in the frame, the mapper's has not


def test_the_dots_lie_where_the_seeds_project(scenes):
    contexts, _ = scenes

    def one(ctx):
        return ctx.seeds_at(torch.tensor([[100.5, 60.5]]), 2.0)

    picture, seeds = rule_picture(one, contexts["first"])
    red = np.argwhere((picture == (255, 48, 64)).all(-1))
    assert len(seeds) == 1
    assert np.abs(red - (60, 100)).max() <= 1


def test_the_table_of_rules_has_a_sentence_and_the_options_of_each():
    table = rule_table()
    rows = {name: (sentence, options) for name, sentence, options in table.rows}
    assert set(rows) == set(registered())
    assert all(len(sentence) < 130 for sentence, _ in rows.values())
    assert all(sentence.endswith((".", ")")) for sentence, _ in rows.values())
    assert "`" not in repr(table)
    assert rows["uniform"][1] == rule_options("uniform")
    html = table._repr_html_()
    assert html.count("<tr>") == 1 + len(rows)
    assert "fraction 0.05, required_weight 1, coverage yes" in html
