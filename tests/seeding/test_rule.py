"""Registry, signatures, options, checked results, one seed per voxel."""

import inspect
import re
from pathlib import Path
from typing import Literal

import pytest
import torch

from gsfusion_nb.seeding import (
    SeedContext,
    Seeds,
    apply_rule,
    check_contexts,
    get_rule,
    keep_one_per_voxel,
    published_training,
    registered,
    rule_choices,
    rule_options,
    seeding_rule,
    trained_otherwise,
    voxel_index,
)
from gsfusion_nb.seeding.rules import gaussian_slam


@pytest.fixture
def ctx() -> SeedContext:
    return check_contexts()["new"]


def some_seeds(n: int = 3) -> Seeds:
    xyz = torch.arange(3.0 * n).reshape(n, 3) / 10
    return Seeds.isotropic(
        xyz,
        torch.full((n, 3), 0.5),
        torch.full((n,), 0.01),
    )


def test_registered_by_function_name_and_replaced_by_running_the_cell_again():
    def make(depth):
        @seeding_rule
        def near_only(ctx: SeedContext, *, max_depth_m: float = depth) -> Seeds:
            return ctx.cells()

        return near_only

    first = make(1.0)
    second = make(2.0)
    assert get_rule("near_only") is second
    assert get_rule(first) is first
    assert registered()["near_only"] is second
    assert rule_options("near_only") == {"max_depth_m": 2.0}
    assert rule_options(first) == {"max_depth_m": 1.0}


def no_context():
    return some_seeds()


def star(*ctx):
    return some_seeds()


def positional(ctx, depth_m=1.0):
    return some_seeds()


def no_default(ctx, *, depth_m):
    return some_seeds()


def any_keyword(ctx, **options):
    return some_seeds()


def listed(ctx, *, sizes=(1, 2)):
    return some_seeds()


def free_word(ctx, *, where="near"):
    return some_seeds()


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [
        (
            no_context,
            r"def no_context\(ctx, \*, number=default, ...\) -> Seeds; this one does not take the "
            r"context",
        ),
        (star, "does not take the context as its first argument"),
        (positional, "'depth_m=1.0' must be keyword-only: put it after a bare"),
        (no_default, "option 'depth_m' has no default"),
        (any_keyword, "must be keyword-only"),
        (
            listed,
            r"default of option 'sizes' must be a number, True/False, a text or a Path, got \(1, "
            r"2\)",
        ),
        (free_word, r'where: Literal\["near", ...\] = "near"'),
        (lambda ctx: some_seeds(), "'<lambda>' is not a name: use def"),
    ],
)
def test_bad_signatures_are_refused_with_a_sentence(bad, sentence):
    before = registered()
    with pytest.raises(TypeError, match=sentence):
        seeding_rule(bad)
    assert registered() == before


def switches(
    ctx,
    *,
    n: int = 3,
    far: bool = False,
    where: Literal["near", "far"] = "near",
) -> Seeds:
    return some_seeds(n)


def test_options_and_choices():
    assert rule_options(switches) == {"n": 3, "far": False, "where": "near"}
    assert rule_choices(switches) == {"where": ("near", "far")}
    assert rule_options("gsfusion") == {
        "required_weight": 1.0,
        "coverage": True,
        "coarseness": 1.0,
    }


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"m": 1}, r"'switches' has no options \['m'\]; known: \['far', 'n', 'where'\]"),
        ({"n": "3"}, "option 'n' must be a number, got '3'"),
        ({"n": True}, "option 'n' must be a number, got True"),
        ({"far": 1}, "option 'far' must be True or False, got 1"),
        ({"where": "left"}, r"option 'where' must be \('near', 'far'\), got 'left'"),
    ],
)
def test_wrong_options_are_refused(options, sentence, ctx):
    with pytest.raises(TypeError, match=sentence):
        apply_rule(switches, ctx, options)


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (
            lambda: None,
            TypeError,
            r"'faulty' returned invalid seeds: expected Seeds, got NoneType \(is there a ret",
        ),
        (lambda: [1, 2], TypeError, "expected Seeds, got list"),
        (
            lambda: {"scale_m": torch.zeros(3, 3)},
            ValueError,
            "scale_m must be above 0 .*, got 0 to 0",
        ),
        (lambda: {"scale_m": torch.ones(3)}, ValueError, r"scale_m must be \[3, 3\], got \[3\]"),
        (
            lambda: {"rgb": torch.full((3, 3), 128.0)},
            ValueError,
            "rgb must be in 0..1, got 128 to 128",
        ),
        (
            lambda: {"opacity": torch.ones(3)},
            ValueError,
            "opacity must be strictly between 0 and 1",
        ),
        (lambda: {"quat": torch.zeros(3, 4)}, ValueError, "length of quat must be above 0"),
        (
            lambda: {"xyz_W": torch.full((3, 3), float("nan"))},
            ValueError,
            "xyz_W must be finite, got 9 NaN",
        ),
        (
            lambda: {"xyz_W": torch.ones(3, 3).long()},
            ValueError,
            "xyz_W must be floating point, got torch.int64",
        ),
    ],
)
def test_unusable_results_name_the_rule_and_what_came(make, error, sentence, ctx):
    value = make()

    def faulty(ctx):
        if not isinstance(value, dict):
            return value
        seeds = some_seeds()
        for (
            name,
            column,
        ) in value.items():  # past the type check of Seeds, which is off outside the tests
            object.__setattr__(seeds, name, column)
        return seeds

    with pytest.raises(error, match=sentence):
        apply_rule(faulty, ctx)


def test_one_per_voxel_keeps_the_largest_and_of_equals_the_first():
    voxel = torch.tensor([[0, 0, 0], [5, 0, 0], [0, 0, 0], [5, 0, 0], [-1, 0, 0], [5, 0, 0]])
    size = torch.tensor([1.0, 2.0, 3.0, 2.0, 0.5, 1.0])
    seeds = Seeds.isotropic(
        voxel.float(),
        torch.zeros(6, 3),
        size,
        tag=torch.arange(6),
    )
    assert keep_one_per_voxel(seeds, voxel).tag.tolist() == [1, 2, 4]
    assert len(keep_one_per_voxel(seeds[:0], voxel[:0])) == 0


def test_the_page_marks_the_rules_that_their_publication_trains_otherwise():
    page = (Path(__file__).parents[2] / "docs/seeding_rules.md").read_text()
    said = {name: published_training(rule) for name, rule in registered().items()}
    marked = {name: words for name, words in said.items() if words}
    assert {"vtgaussian", "gaussian_slam", "rtg_slam"} <= set(marked)
    assert set(re.findall(r"(?m)^\| \[`(\w+)`\]\([^)]*\) † \|", page)) == set(marked)
    assert (
        dict(
            re.findall(r"(?m)^\| `(\w+)` \| (.*) \|$", page.split("how its publication trains")[1])
        )
        == marked
    )


def test_a_rule_made_from_a_marked_one_is_not_marked():
    class mine(registered()["vtgaussian"]):  # pyright: ignore
        pass

    assert published_training(mine) == ""
    assert published_training(trained_otherwise("by hand")(mine)) == "by hand"


@pytest.mark.parametrize(
    ("register", "given", "sentence"),
    [
        (
            seeding_rule,
            3,
            "@seeding_rule decorates a function, got int; write it without parentheses",
        ),
        (get_rule, 3, "a seeding rule is a name or a function, got int"),
        (
            get_rule,
            gaussian_slam(),
            r"pass the class gaussian_slam itself as the seeding rule, .* seeding__options={...}",
        ),
    ],
)
def test_what_is_no_rule(register, given, sentence):
    with pytest.raises(TypeError, match=sentence):
        inspect.unwrap(register)(given)  # past the type check, which is off outside the tests


def test_one_per_voxel_through_apply_rule(ctx):
    every = apply_rule("dense", ctx)
    single = apply_rule("dense", ctx, one_per_voxel=True)
    voxels = voxel_index(ctx, single.xyz_W)
    assert len(torch.unique(voxels, dim=0)) == len(single) < len(every)
    assert len(torch.unique(voxel_index(ctx, every.xyz_W), dim=0)) == len(single)


def test_one_per_voxel_counts_the_gaussians_of_the_map():
    voxel = torch.tensor([[0, 0, 0], [5, 0, 0], [-1, 0, 0], [5, 0, 0]])
    seeds = Seeds.isotropic(
        voxel.float(),
        torch.zeros(4, 3),
        torch.ones(4),
        tag=torch.arange(4),
    )
    taken = torch.tensor([[5, 0, 0], [0, 0, 1], [5, 0, 0]])
    assert keep_one_per_voxel(seeds, voxel, taken).tag.tolist() == [0, 2]
    assert len(keep_one_per_voxel(seeds, voxel, voxel)) == 0
    assert keep_one_per_voxel(seeds, voxel, taken[:0]).tag.tolist() == [0, 1, 2]
    assert len(keep_one_per_voxel(seeds[:0], voxel[:0], taken)) == 0


def from_files(
    ctx, *, weights: Path = Path("weights.pt"), label: str = "none", n: int = 3
) -> Seeds:
    return some_seeds(n)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"weights": 3}, "option 'weights' must be the path of a file or folder, got 3"),
        ({"label": 3}, "option 'label' must be a text, got 3"),
        ({"n": None}, "option 'n' must be a number, got None"),
    ],
)
def test_options_that_are_paths_or_texts(options, sentence, ctx):
    assert rule_options(from_files) == {"weights": Path("weights.pt"), "label": "none", "n": 3}
    for path in ("other.pt", Path("other.pt")):
        assert len(apply_rule(from_files, ctx, {"weights": path, "label": "any word"})) == 3
    with pytest.raises(TypeError, match=sentence):
        apply_rule(from_files, ctx, options)
