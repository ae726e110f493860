"""What an ``Edit`` does to the rows of a map, by hand, and what it refuses."""

import math
import warnings
from typing import Any

import pytest
import torch

from gsfusion_nb.gaussians import STABLE, UNSTABLE, Edit, GaussianModel, SurfelModel, shared
from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.types import Seeds


def seeds(n: int, generator: torch.Generator, opacity: float = 0.5) -> Seeds:
    def uniform(*size: int):
        return torch.rand(*size, generator=generator)

    return Seeds(
        xyz_W=uniform(n, 3),
        rgb=uniform(n, 3),
        scale_m=0.01 + uniform(n, 3),
        quat=torch.randn(n, 4, generator=generator),
        opacity=torch.full((n,), opacity),
        tag=torch.arange(n, dtype=torch.int32),
    )


def filled(generator, n: int = 6, kind: type[GaussianModel] = GaussianModel) -> Any:
    """A map of ``n`` rows after 40 steps, with moments that tell the rows apart."""
    model = kind(sh_degree=1)
    model.append(seeds(n, generator), 3)
    for moments in (
        (model.moments.exp_avg, model.moments.exp_avg_sq) if "exp_avg.sh" in model.columns else ()
    ):
        for column in vars(moments).values():
            column.copy_(
                1 + torch.arange(n).reshape(-1, *[1] * (column.ndim - 1)).expand_as(column)
            )
    model.clock.advance(40)
    return model


def rows(model: GaussianModel) -> dict[str, torch.Tensor]:
    return {name: column.clone() for name, column in model.columns.items()}


def mask(n: int, *numbers: int) -> torch.Tensor:
    return torch.isin(torch.arange(n), torch.tensor(numbers))


def assert_no_moments(model: GaussianModel, which) -> None:
    for moments in (model.moments.exp_avg, model.moments.exp_avg_sq):
        assert all(not column[which].any() for column in vars(moments).values())


def test_nothing_asked_for_changes_nothing(generator):
    model = filled(generator)
    before = rows(model)
    assert not Edit()
    assert model.edit(Edit(), generator).tolist() == list(range(6))
    assert all(torch.equal(before[name], column) for name, column in model.columns.items())


def test_set_writes_what_is_stored_and_what_is_seen(generator):
    model = filled(generator)
    before = rows(model)
    which = torch.tensor([4, 1])
    edit = Edit(
        set={
            "xyz_W": (which, torch.tensor([[1.0, 2, 3], [4, 5, 6]])),
            "scale_m": (which, torch.full((2, 3), 0.02)),
            "opacity": (mask(6, 0), torch.tensor([0.25])),
            "rgb": (which, torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.5]])),
            "tag": (which, torch.tensor([7, 8])),
        }
    )
    assert edit
    model.edit(edit, generator)
    assert model.params.xyz_W[[4, 1]].tolist() == [[1, 2, 3], [4, 5, 6]]
    torch.testing.assert_close(model.scale_m[which], torch.full((2, 3), 0.02))
    torch.testing.assert_close(model.opacity[0], torch.tensor(0.25))
    torch.testing.assert_close(
        model.rgb[which],
        torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.5]]),
    )
    assert model.tag.tolist() == [0, 8, 2, 3, 7, 5]
    same = [0, 2, 3, 5]
    assert torch.equal(model.params.xyz_W[same], before["xyz_W"][same])
    for name in [n for n in model.columns if n.startswith("exp_avg")]:
        assert torch.equal(model.columns[name], before[name])


def test_a_lower_opacity_for_all(generator):
    model = filled(generator)
    model.params.opacity_logit.copy_(torch.tensor([-3.0, -1, 0, 1, 2, 5]))
    model.edit(Edit(reset_opacity=0.5), generator)
    assert model.params.opacity_logit.tolist() == [-3.0, -1, 0, 0, 0, 0]
    assert not model.moments.exp_avg.opacity_logit.any()
    assert not model.moments.exp_avg_sq.opacity_logit.any()
    assert model.moments.exp_avg.xyz_W.all()


def test_copies_are_equal_but_for_their_moments_and_their_age(generator):
    model = filled(generator)
    model.row_memory("seen").copy_(torch.arange(6.0))
    before = rows(model)
    origin = model.edit(
        Edit(clone=torch.tensor([2, 2, 5])),
        generator,
        frame_index=9,
    )
    assert origin.tolist() == [0, 1, 2, 3, 4, 5, -1, -1, -1]
    for name in (*PARAMETERS, "birth_frame", "tag", "memory.seen"):
        assert torch.equal(
            model.columns[name],
            before[name][[0, 1, 2, 3, 4, 5, 2, 2, 5]],
        ), name
    assert_no_moments(model, slice(6, None))
    assert model.moments.exp_avg.xyz_W[:6].all()
    assert model.clock.birth.tolist() == [0] * 6 + [40] * 3


@pytest.mark.parametrize("n", [2, 3, 7, 51])
def test_the_copies_of_a_gaussian_together_look_as_it_did(n):
    """In the middle: 1 - (1 - o')^n = o. Of the whole: the light that n copies absorb along a line
    through the middle has the same integral, which is how the paper chooses the scale."""
    o = torch.tensor([0.02, 0.4, 0.9, 0.99])
    s = 0.3
    opacity, scale_m = shared(
        o,
        torch.full((4, 3), s),
        torch.full((4,), n),
        min_opacity=1e-6,
    )
    torch.testing.assert_close(
        1 - (1 - opacity.double()) ** n,
        o.double(),
        atol=1e-5,
        rtol=1e-5,
    )
    x = torch.linspace(-12 * s, 12 * s, 40_001, dtype=torch.float64)
    for k in range(4):
        one = (
            1 - (1 - opacity[k].double() * torch.exp(-((x / scale_m[k, 0].double()) ** 2) / 2)) ** n
        )
        expected = (o[k].double() * torch.exp(-((x / s) ** 2) / 2)).sum()
        assert float(one.sum() / expected) == pytest.approx(1, abs=1e-4)


def test_of_one_copy_nothing_changes():
    o = torch.tensor([0.3, 0.001])
    s = torch.rand(2, 3)
    opacity, scale_m = shared(o, s, torch.ones(2, dtype=torch.int64))
    torch.testing.assert_close(opacity, torch.tensor([0.3, 0.005]))
    assert torch.equal(scale_m, s)


def test_rows_are_moved_to_others_and_share_their_opacity(generator):
    model = filled(generator)
    before = rows(model)
    scale_m = model.scale_m.clone()
    model.edit(
        Edit(relocate=(torch.tensor([0, 1, 2]), torch.tensor([4, 5, 4]))),
        generator,
    )
    assert len(model) == 6
    torch.testing.assert_close(
        model.opacity[[0, 2, 4]],
        torch.full((3,), 1 - 0.5 ** (1 / 3)),
    )
    torch.testing.assert_close(
        model.opacity[[1, 5]],
        torch.full((2,), 1 - 0.5**0.5),
    )
    share = torch.tensor(1 - 0.5**0.5)
    expected = 0.5 / (2 * share - share**2 / math.sqrt(2))
    torch.testing.assert_close(model.scale_m[5], scale_m[5] * expected)
    for name in (*PARAMETERS, "tag", "birth_frame"):
        column = model.columns[name]
        assert torch.equal(column[[0, 1, 2]], column[[4, 5, 4]])
        assert torch.equal(column[3], before[name][3])
    assert_no_moments(model, [4, 5])
    assert model.moments.exp_avg.xyz_W[[0, 1, 2], 0].tolist() == [1, 2, 3]  # as in gsplat
    assert model.clock.birth.tolist() == [0, 0, 0, 0, 40, 40]


def test_the_halves_of_a_row(generator):
    """Their offsets, in the Gaussian's own axes and standard deviations, are standard normal."""
    model = filled(generator)
    p = model.params
    n = 4000
    p.quat[1] = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])  # x goes to y
    p.log_scale[1] = torch.tensor([0.3, 0.01, 0.02]).log()
    centre = p.xyz_W[1].clone()
    sh = p.sh[1].clone()
    model.edit(Edit(keep=mask(6, 1)), generator)
    model.edit(Edit(clone=torch.zeros(n - 1, dtype=torch.int64)), generator)
    origin = model.edit(Edit(split=torch.arange(n), split_shares=True), generator)
    assert origin.tolist() == [-1] * (2 * n)
    torch.testing.assert_close(
        model.scale_m,
        torch.tensor([[0.3, 0.01, 0.02]]).expand(2 * n, 3) / 1.6,
    )
    torch.testing.assert_close(
        model.opacity,
        torch.full((2 * n,), 1 - math.sqrt(0.5)),
    )
    away = (model.params.xyz_W - centre) / torch.tensor([0.01, 0.3, 0.02])
    torch.testing.assert_close(
        away.mean(0),
        torch.zeros(3),
        atol=0.05,
        rtol=0,
    )
    torch.testing.assert_close(
        away.T.cov(),
        torch.eye(3),
        atol=0.08,
        rtol=0,
    )
    assert torch.equal(model.params.sh, sh.expand(2 * n, -1, -1))
    assert_no_moments(model, slice(None))
    assert model.tag.tolist() == [1] * (2 * n)


def test_everything_at_once_in_the_order_of_the_fields(generator):
    model = filled(generator)
    new = seeds(2, generator, opacity=0.8)
    edit = Edit(
        set={"opacity": (torch.tensor([0]), torch.tensor([0.9]))},
        reset_opacity=0.6,
        clone=torch.tensor([0]),
        split=mask(6, 3),
        add=new,
        keep=~mask(6, 1),
    )
    origin = model.edit(edit, generator, frame_index=12)
    assert origin.tolist() == [0, 2, 4, 5, -1, -1, -1, -1, -1]
    assert model.tag.tolist() == [0, 2, 4, 5, 0, 3, 3, 0, 1]
    assert model.birth_frame.tolist() == [3] * 7 + [12] * 2
    torch.testing.assert_close(model.opacity[[0, 4]], torch.tensor([0.6, 0.6]))
    torch.testing.assert_close(model.opacity[7:], torch.tensor([0.8, 0.8]))
    assert torch.equal(model.params.xyz_W[7:], new.xyz_W)
    assert model.moments.exp_avg.xyz_W[:4, 0].tolist() == [1, 3, 5, 6]
    assert_no_moments(model, slice(4, None))


def test_factors_of_learning_rates_stay_with_their_rows(generator):
    model = filled(generator)
    assert not model.rates
    factors = torch.tensor([0.0, 1, 2, 0, 0.5, 1])
    model.edit(Edit(rates={"xyz_W": factors}), generator)
    model.append(seeds(3, generator))
    model.edit(
        Edit(clone=torch.tensor([0]), keep=~mask(9, 1, 7)),
        generator,
    )
    expected = [0.0, 2, 0, 0.5, 1, 1, 1, 0]
    assert model.rates["xyz_W"].tolist() == expected
    again = GaussianModel.from_state_dict(model.state_dict())
    assert again.rates["xyz_W"].tolist() == expected
    again.append(seeds(5000, generator))
    assert again.rates["xyz_W"].tolist() == expected + [1.0] * 5000


def test_numbers_of_a_rule_stay_with_their_rows(generator):
    model = filled(generator)
    model.row_memory("seen").add_(torch.arange(6.0))
    model.append(seeds(2, generator))
    model.edit(
        Edit(clone=torch.tensor([5]), keep=~mask(8, 0)),
        generator,
    )
    assert model.row_memory("seen").tolist() == [1, 2, 3, 4, 5, 0, 0, 5]
    again = GaussianModel.from_state_dict(model.state_dict())
    assert again.memory["seen"].tolist() == [1, 2, 3, 4, 5, 0, 0, 5]
    again.edit(Edit(clone=torch.tensor([4]), clone_shares=True), generator)
    assert again.memory["seen"].tolist() == [1, 2, 3, 4, 5, 0, 0, 5, 0]


def test_a_snapshot_brings_everything_back(generator):
    model = filled(generator)
    model.row_memory("seen").fill_(2.0)
    before = rows(model)
    snapshot = model.columns.snapshot()
    model.append(seeds(6000, generator))
    model.edit(
        Edit(rates={"sh": torch.zeros(6006)}, keep=~mask(6006, 2)),
        generator,
    )
    model.params.xyz_W.zero_()
    model.columns.restore(snapshot)
    assert len(model) == 6
    assert list(model.columns) == list(before)
    assert all(torch.equal(before[name], column) for name, column in model.columns.items())
    model.append(seeds(3, generator))
    assert_no_moments(model, slice(6, None))
    assert not model.params.sh[6:, 1:].any()


def test_states_and_anchors_of_surfels(generator):
    model = filled(generator, kind=SurfelModel)
    model.state.fill_(STABLE)
    model.confidence.fill_(50)
    model.frames_in_view.fill_(7)
    edit = Edit(
        set={
            "xyz_W": (torch.tensor([1]), torch.ones(1, 3)),
            "state": (torch.tensor([2, 3]), torch.tensor([UNSTABLE, STABLE])),
        },
        relocate=(torch.tensor([5]), torch.tensor([4])),
        clone=torch.tensor([0]),
        split=torch.tensor([3]),
    )
    model.edit(edit, generator)
    assert model.state.tolist() == [
        STABLE,
        STABLE,
        UNSTABLE,
        UNSTABLE,
        UNSTABLE,
        UNSTABLE,
        UNSTABLE,
        UNSTABLE,
    ]
    assert model.confidence.tolist() == [50, 50, 0, 0, 0, 0, 0, 0]
    assert model.frames_in_view.tolist() == [7, 7, 0, 0, 0, 0, 0, 0]
    assert model.clock.birth.tolist() == [0, 0, 40, 40, 40, 40, 40, 40]
    for name in ("xyz_W", "log_scale", "quat"):
        assert torch.equal(model.anchor[name], model.columns[name])


SIX = torch.ones(6)
MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"rates": {"colour": SIX}}, "rates: no parameter 'colour'"),
    ({"rates": {"xyz_W": -SIX}}, "rates: xyz_W"),
    ({"rates": {"xyz_W": SIX[:5]}}, "rates: xyz_W"),
    ({"set": {"colour": (mask(6, 1), SIX[:1])}}, "set: no column 'colour'"),
    ({"set": {"xyz_W": mask(6, 1)}}, "set: xyz_W must be a pair"),
    ({"set": {"xyz_W": (mask(6, 1), torch.full((1, 3), torch.nan))}}, "xyz_W must be finite"),
    ({"set": {"xyz_W": (mask(6, 1, 2), torch.ones(1, 3))}}, r"set: xyz_W must be \[2, 3\]"),
    ({"set": {"opacity": (mask(6, 1), torch.ones(1))}}, "set: opacity"),
    ({"set": {"scale_m": (mask(6, 1), torch.zeros(1, 3))}}, "set: scale_m"),
    ({"set": {"rgb": (mask(6, 1), torch.full((1, 3), 2.0))}}, "set: rgb"),
    ({"set": {"tag": (mask(6, 1), torch.ones(1))}}, "set: tag"),
    ({"set": {"state": (mask(6, 1), torch.tensor([1]))}}, "set: no column 'state' in this map"),
    (
        {"set": {"opacity": (mask(6, 1), SIX[:1] / 2), "opacity_logit": (mask(6, 2), SIX[:1])}},
        "are the same numbers",
    ),
    (
        {"set": {"opacity": (torch.tensor([6]), SIX[:1] / 2)}},
        "rows of opacity: rows must be between 0 and 5",
    ),
    ({"set": {"opacity": (mask(5, 1), SIX[:1] / 2)}}, "rows of opacity, as a mask"),
    ({"reset_opacity": 1.0}, "reset_opacity"),
    ({"min_opacity": 0.0}, "min_opacity"),
    ({"clone": torch.tensor([-1])}, "clone: rows must be between 0 and 5"),
    ({"clone": torch.tensor([1.0])}, "clone must be row numbers"),
    ({"split": [1, 2]}, "split must be row numbers"),
    ({"clone": mask(6, 1, 2), "split": mask(6, 2)}, "row 2 is both cloned and split"),
    ({"keep": torch.arange(6)}, "keep must be boolean"),
    ({"keep": mask(5, 1)}, r"keep must be \[6\]"),
    (
        {"relocate": (torch.tensor([1]), torch.tensor([1]))},
        "relocate: row 1 is both moved and moved to",
    ),
    ({"relocate": (torch.tensor([1, 1]), torch.tensor([2, 3]))}, "a row can be moved only once"),
    ({"relocate": (torch.tensor([1]), torch.tensor([2, 3]))}, "relocate must have one row"),
    ({"relocate": (mask(6, 1), mask(6, 2))}, "relocate must be a pair of row numbers"),
    (
        {"relocate": (torch.tensor([1]), torch.tensor([2])), "keep": ~mask(6, 2)},
        "row 2 is both moved to and removed",
    ),
    (
        {
            "add": Seeds.isotropic(
                torch.full((1, 3), torch.inf),
                torch.ones(1, 3),
                SIX[:1],
            )
        },
        "add: xyz_W",
    ),
    (
        {
            "add": Seeds.isotropic(
                torch.ones(1, 3),
                torch.ones(1, 3),
                0 * SIX[:1],
            )
        },
        "add: scale_m",
    ),
    (
        {
            "add": Seeds.isotropic(
                torch.ones(1, 3),
                torch.full((1, 3), torch.nan),
                SIX[:1],
            )
        },
        "add: rgb must be finite",
    ),
    (
        {
            "add": Seeds.isotropic(
                torch.ones(1, 3),
                torch.ones(1, 3),
                SIX[:1],
                opacity=1.0,
            )
        },
        "add: opacity must lie str",
    ),
    (
        {
            "add": Seeds.isotropic(
                torch.ones(1, 3),
                torch.ones(1, 3),
                SIX[:1],
                opacity=0.0,
            )
        },
        "add: opacity must lie str",
    ),
    ({"rates": {"xyz_W": torch.full((6,), torch.inf)}}, "rates: xyz_W must be finite floats"),
    ({"rates": {"xyz_W": torch.ones(6, dtype=torch.int64)}}, "rates: xyz_W must be finite floats"),
    (
        {"set": {"xyz_W": [mask(6, 1), torch.ones(1, 3)]}},
        "xyz_W must be a pair .* of tensors, got list",
    ),
    ({"set": {"sh": (mask(6, 1), torch.ones(1, 3))}}, r"set: sh must be \[1, 4, 3\]"),
    (
        {"set": {"opacity": (mask(6, 1), torch.zeros(1))}},
        "set: opacity must be between 0.0 and 1.0, got 0",
    ),
    (
        {"set": {"rgb": (mask(6, 1), torch.full((1, 3), -0.1))}},
        "set: rgb must be between 0.0 and 1.0, got -0.1",
    ),
    (
        {"set": {"xyz_W": (mask(6, 1), torch.ones(1, 3, dtype=torch.int64))}},
        "xyz_W must not be torch.int64",
    ),
    (
        {"set": {"opacity": (torch.tensor([-1]), SIX[:1] / 2)}},
        "rows of opacity: rows must be between 0 and 5",
    ),
    ({"clone": torch.ones(1, 1, dtype=torch.int64)}, "clone must be row numbers"),
    (
        {"relocate": (torch.tensor([1]), torch.tensor([2])), "keep": ~mask(6, 1)},
        "row 1 is both relocated and removed",
    ),
    ({"relocate": torch.tensor([1, 2])}, "relocate must be a pair of row numbers"),
    (
        {"relocate": (torch.tensor([1]), torch.tensor([7]))},
        "relocate: rows must be between 0 and 5, got 7 to 7",
    ),
]


@pytest.mark.parametrize("how", ["split", "clone"])
def test_a_row_that_is_split_or_copied_and_removed_goes_with_what_is_made_of_it(generator, how):
    """gsplat's order: duplicate and split, then prune. The other rows are what they are without the
    removed one."""
    keep = ~mask(6, 1)
    both = (
        Edit(split=mask(6, 1, 4), keep=keep)
        if how == "split"
        else Edit(clone=mask(6, 1, 4), keep=keep)
    )
    apart = (
        Edit(split=mask(6, 4), keep=keep) if how == "split" else Edit(clone=mask(6, 4), keep=keep)
    )
    models = [filled(torch.Generator().manual_seed(3)) for _ in range(2)]
    for model, edit in zip(models, (both, apart), strict=True):
        model.edit(edit, torch.Generator().manual_seed(5))
    assert len(models[0]) == 6
    assert all(
        torch.equal(column, models[1].columns[name]) for name, column in models[0].columns.items()
    )


def unchecked(**fields: Any) -> Edit:
    """An edit made without the checks of types that tests switch on; users have only those of the
    class."""
    edit = Edit()
    for name, value in fields.items():
        object.__setattr__(edit, name, value)
    return edit


@pytest.mark.parametrize(
    ("fields", "sentence"), MISTAKES, ids=[sentence[:40] for _, sentence in MISTAKES]
)
def test_mistakes_are_sentences_and_change_nothing(generator, fields, sentence):
    model = filled(generator)
    before = rows(model)
    with pytest.raises(ValueError, match=sentence):
        model.edit(unchecked(**fields), generator)
    assert all(torch.equal(before[name], column) for name, column in model.columns.items())


NAMES = {
    "means": "xyz_W",
    "scales": "log_scale",
    "quats": "quat",
    "opacities": "opacity_logit",
    "sh": "sh",
}
N = 12


@pytest.fixture(scope="module")
def ops() -> Any:
    """``gsplat.strategy.ops``, whose CUDA kernel of Eq. 9 is written out in Python here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ops = pytest.importorskip(
            "gsplat.strategy.ops", reason="gsplat is not installed: pip install gsplat==1.5.3"
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops, "compute_relocation", relocation_kernel)
        yield ops


def relocation_kernel(opacities, scales, ratios, binoms):
    """Line by line ``relocation_kernel`` of gsplat's Relocation.cu, in double precision."""
    new_opacities = torch.empty_like(opacities)
    new_scales = torch.empty_like(scales)
    for idx, n_idx in enumerate(ratios.clamp(1, len(binoms)).tolist()):
        new = 1.0 - (1.0 - float(opacities[idx])) ** (1.0 / n_idx)
        denom_sum = 0.0
        for i in range(1, n_idx + 1):
            for k in range(i):
                denom_sum += (
                    float(binoms[i - 1, k]) * (-1.0) ** k / math.sqrt(k + 1) * new ** (k + 1)
                )
        new_opacities[idx] = new
        new_scales[idx] = float(opacities[idx]) / denom_sum * scales[idx]
    return new_opacities, new_scales


@pytest.fixture
def pair(generator):
    """The same map for both, with moments."""
    model = GaussianModel(sh_degree=1)
    model.append(
        Seeds(
            xyz_W=torch.rand(N, 3, generator=generator),
            rgb=torch.rand(N, 3, generator=generator),
            scale_m=0.01 + torch.rand(N, 3, generator=generator),
            quat=torch.randn(N, 4, generator=generator),
            opacity=0.01 + 0.98 * torch.rand(N, generator=generator),
            tag=torch.zeros(N, dtype=torch.int32),
        )
    )
    params = torch.nn.ParameterDict()
    optimisers = {}
    for theirs, ours in NAMES.items():
        params[theirs] = torch.nn.Parameter(getattr(model.params, ours).clone())
        optimisers[theirs] = torch.optim.Adam([params[theirs]], lr=0.0)
        params[theirs].grad = torch.randn(params[theirs].shape, generator=generator)
        optimisers[theirs].step()
        state = optimisers[theirs].state[params[theirs]]
        getattr(model.moments.exp_avg, ours).copy_(state["exp_avg"])
        getattr(model.moments.exp_avg_sq, ours).copy_(state["exp_avg_sq"])
    return model, params, optimisers


def assert_same(model: GaussianModel, params, optimisers, tolerance: float = 1e-6) -> None:
    for theirs, ours in NAMES.items():
        torch.testing.assert_close(
            getattr(model.params, ours), params[theirs].data, atol=tolerance, rtol=tolerance
        )
        state = optimisers[theirs].state[params[theirs]]
        for moment in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(
                getattr(getattr(model, moment), ours), state[moment], atol=0, rtol=0
            )


def seeded(seed: int = 5) -> torch.Generator:
    """The generator of torch itself, which gsplat draws from, and ours, at the same place."""
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def rows_of(*rows: int) -> torch.Tensor:
    return torch.isin(torch.arange(N), torch.tensor(rows))


BINOMS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)])


def test_duplicate(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(clone=rows_of(3, 4, 9)), torch.Generator())
    ops.duplicate(params, optimisers, {}, rows_of(3, 4, 9))
    assert_same(model, params, optimisers)


@pytest.mark.parametrize("shares", [False, True])
def test_split(ops, pair, shares):
    model, params, optimisers = pair
    generator = seeded()
    model.edit(Edit(split=rows_of(0, 5, 6), split_shares=shares), generator)
    ops.split(params, optimisers, {}, rows_of(0, 5, 6), revised_opacity=shares)
    assert_same(model, params, optimisers)


def test_remove(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(keep=~rows_of(0, 11)), torch.Generator())
    ops.remove(params, optimisers, {}, rows_of(0, 11))
    assert_same(model, params, optimisers)


def test_reset_opacity(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(reset_opacity=0.3), torch.Generator())
    ops.reset_opa(params, optimisers, {}, 0.3)
    assert_same(model, params, optimisers)


def test_relocate(ops, pair):
    model, params, optimisers = pair
    dead = torch.tensor([1, 2, 8])
    alive = rows_of(1, 2, 8).logical_not().nonzero()[:, 0]
    drawn = torch.multinomial(
        model.opacity[alive],
        3,
        replacement=True,
        generator=seeded(),
    )
    model.edit(Edit(relocate=(dead, alive[drawn])), torch.Generator())
    ops.relocate(params, optimisers, {}, rows_of(1, 2, 8), BINOMS)
    assert_same(model, params, optimisers, 1e-5)


def test_sample_add(ops, pair):
    model, params, optimisers = pair
    drawn = torch.multinomial(model.opacity, 20, replacement=True, generator=seeded())
    assert len(drawn.unique()) < 12
    model.edit(Edit(clone=drawn, clone_shares=True), torch.Generator())
    ops.sample_add(params, optimisers, {}, 20, BINOMS)
    assert_same(model, params, optimisers, 1e-5)


def test_grow_as_the_default_strategy_does(ops, pair):
    """Duplicate some, split others, then remove: one edit; the rows come in the same order."""
    model, params, optimisers = pair
    generator = seeded()
    model.edit(
        Edit(clone=rows_of(1, 2), split=rows_of(3, 7), keep=~rows_of(0)),
        generator,
    )
    ops.duplicate(params, optimisers, {}, rows_of(1, 2))
    ops.split(
        params,
        optimisers,
        {},
        torch.cat([rows_of(3, 7), torch.zeros(2, dtype=torch.bool)]),
    )
    ops.remove(
        params,
        optimisers,
        {},
        torch.arange(len(params["means"])) == 0,
    )
    assert_same(model, params, optimisers)


@pytest.mark.parametrize(
    ("state", "refused"),
    [(-1, True), (0, False), (1, False), (2, True)],
)
def test_a_state_is_one_of_two(generator, state, refused):
    model = filled(generator, kind=SurfelModel)
    edit = Edit(set={"state": (mask(6, 1), torch.tensor([state], dtype=torch.int32))})
    if refused:
        with pytest.raises(ValueError, match=f"set: state must be between 0 and 1, got {state}"):
            model.edit(edit, generator)
    else:
        model.edit(edit, generator)
        assert int(model.state[1]) == state


@pytest.mark.parametrize(
    "fields",
    [
        {"reset_opacity": 0.5},
        {"relocate": (torch.tensor([0]), torch.tensor([1]))},
        {"clone": mask(6, 1)},
        {"split": mask(6, 1)},
        {"add": Seeds.isotropic(torch.ones(1, 3), torch.ones(1, 3), SIX[:1])},
        {"keep": mask(6, 1)},
        {"rates": {"xyz_W": SIX}},
        {"set": {"rgb": (mask(6, 1), torch.ones(1, 3))}},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_an_edit_asks_for_something_if_any_field_does(fields):
    assert bool(Edit(**fields))
    assert not Edit(min_opacity=0.1, clone_shares=True, split_shares=True)
