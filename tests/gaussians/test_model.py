import pytest
import torch

from gsfusion_nb.gaussians import PLY_BYTES, GaussianModel
from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.types import Seeds


def seeds(n: int, generator: torch.Generator) -> Seeds:
    def uniform(*size: int):
        return torch.rand(*size, generator=generator)

    return Seeds.isotropic(
        uniform(n, 3),
        uniform(n, 3),
        0.01 + uniform(n),
        tag=torch.arange(n),
    )


def test_appended_rows_hold_the_published_initial_values(generator):
    model = GaussianModel(sh_degree=3)
    rgb = torch.tensor([[0.0, 128 / 255, 1.0]])
    model.append(
        Seeds.isotropic(torch.ones(1, 3), rgb, torch.tensor([0.00745356])),
        frame_index=7,
    )
    p = model.params
    # -0.5 / 0.28209479177387814 and log(2 * sqrt(2^2 + 1^2) / 600)
    assert p.sh[0, 0].tolist() == pytest.approx([-1.772454, 0.0069508, 1.772454], abs=1e-5)
    assert p.log_scale[0].tolist() == pytest.approx([-4.899064] * 3, abs=1e-5)
    assert p.opacity_logit.tolist() == [0.0]
    assert p.quat.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert p.sh[0, 1:].abs().max() == 0
    assert p.sh_degree == 3
    assert model.birth_frame.tolist() == [7]


@pytest.mark.parametrize(
    "counts",
    [(0,), (1,), (4096, 1), (5000, 5000, 3)],
)
def test_growth_keeps_old_rows_and_zeroes_new_moments(counts, generator):
    model = GaussianModel(sh_degree=1)
    parts = [seeds(n, generator) for n in counts]
    for i, part in enumerate(parts):
        model.append(part, i)
        for name in PARAMETERS:
            getattr(model.moments.exp_avg, name)[:] += 1.0
    assert len(model) == sum(counts)
    torch.testing.assert_close(model.params.xyz_W, torch.cat([p.xyz_W for p in parts]))
    torch.testing.assert_close(model.scale_m, torch.cat([p.scale_m for p in parts]))
    expected = torch.cat([torch.full((n,), float(len(counts) - i)) for i, n in enumerate(counts)])
    torch.testing.assert_close(model.moments.exp_avg.opacity_logit, expected)


def test_keep_filters_every_column_alike(generator):
    model = GaussianModel(sh_degree=2)
    all_seeds = seeds(50, generator)
    model.append(all_seeds, 3)
    model.moments.exp_avg.xyz_W.copy_(all_seeds.xyz_W)
    rows = torch.rand(50, generator=generator) > 0.5
    model.keep(rows)
    assert len(model) == int(rows.sum())
    torch.testing.assert_close(model.params.xyz_W, all_seeds.xyz_W[rows])
    torch.testing.assert_close(model.moments.exp_avg.xyz_W, all_seeds.xyz_W[rows])
    assert model.tag.tolist() == rows.nonzero()[:, 0].tolist()


def test_state_round_trip(generator):
    model = GaussianModel(sh_degree=1)
    model.append(seeds(5000, generator), 2)
    model.clock.advance(17)
    again = GaussianModel.from_state_dict(model.state_dict())
    assert again.clock.count == 17
    for name in PARAMETERS:
        assert torch.equal(getattr(again.params, name), getattr(model.params, name))
        assert torch.equal(
            getattr(again.moments.exp_avg_sq, name), getattr(model.moments.exp_avg_sq, name)
        )


def test_rows_that_take_the_place_of_removed_ones_start_from_zero(generator):
    model = GaussianModel(sh_degree=1)
    model.append(seeds(6, generator))
    for values in (model.params, model.moments.exp_avg, model.moments.exp_avg_sq):
        values.sh.fill_(3.0)
        values.xyz_W.fill_(3.0)
    model.keep(torch.arange(6) < 2)
    more = seeds(5, generator)
    model.append(more)
    assert (model.moments.exp_avg.sh[:2] == 3).all()
    assert not model.params.sh[2:, 1:].any()
    for moments in (model.moments.exp_avg, model.moments.exp_avg_sq):
        assert not any(column[2:].any() for column in vars(moments).values())
    torch.testing.assert_close(model.params.xyz_W[2:], more.xyz_W)


def test_a_log_brings_back_rows_that_were_said_to_change(generator):
    """Also rows that were said twice, or that are new."""
    model = GaussianModel(sh_degree=0)
    model.append(seeds(5, generator))
    before = model.columns.snapshot()
    undo = model.undo_log.begin()
    model.undo_log.will_change(torch.tensor([1, 3]))
    model.params.xyz_W[1] += 1
    model.append(seeds(2, generator))
    model.undo_log.will_change(torch.tensor([3, 4, 5, 6]))
    model.params.xyz_W[3:] += 1
    model.undo_log.will_change(torch.tensor([1]))
    model.params.xyz_W[1] += 1
    undo()
    assert len(model) == 5
    for name, column in model.columns.items():
        assert torch.equal(column, before[name]), name
    model.undo_log.begin()
    model.undo_log.end()
    model.undo_log.will_change(torch.tensor([0]))
    model.params.xyz_W[0] += 1
    assert not torch.equal(model.params.xyz_W, before["xyz_W"])


@pytest.mark.parametrize(
    ("given", "own"),
    [(0, 2), (1, 1), (3, 1), (2, 3)],
)
def test_colours_of_another_degree_are_cut_or_padded(given, own, generator):
    source = GaussianModel(sh_degree=given)
    source.append(seeds(4, generator))
    source.params.sh.copy_(torch.rand(source.params.sh.shape, generator=generator))
    model = GaussianModel(sh_degree=own)
    model.append(seeds(2, generator), 5)
    model.clock.advance(9)
    model.extend(source.params)
    shared = min((given + 1) ** 2, (own + 1) ** 2)
    assert torch.equal(
        model.params.sh[2:, :shared],
        source.params.sh[:, :shared],
    )
    assert not model.params.sh[2:, shared:].any()
    for name in PARAMETERS[:-1]:
        assert torch.equal(getattr(model.params, name)[2:], getattr(source.params, name))
        assert not getattr(model.moments.exp_avg, name)[2:].any()
    assert model.birth_frame.tolist() == [5, 5, -1, -1, -1, -1]
    assert model.clock.birth.tolist() == [0, 0, 9, 9, 9, 9]
    assert model.tag.tolist()[2:] == [0] * 4
    assert PLY_BYTES * len(model) == 6 * 62 * 4


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_rows_that_are_not_finite_are_refused(value, generator):
    source = GaussianModel(sh_degree=0)
    model = GaussianModel(sh_degree=0)
    source.append(seeds(4, generator))
    source.params.quat[1, 2] = value
    with pytest.raises(ValueError, match=r"must be finite, got NaN or infinities: .*'quat': 1"):
        model.extend(source.params)
    assert len(model) == 0


def test_growth_clears_what_a_dropped_row_left_behind(generator):
    model = GaussianModel(sh_degree=0)
    model.append(seeds(10, generator))
    model.moments.exp_avg_sq.xyz_W.fill_(3.0)
    model.keep(torch.arange(10) < 4)
    model.append(seeds(6, generator))
    assert model.moments.exp_avg_sq.xyz_W[:4].eq(3.0).all()
    assert model.moments.exp_avg_sq.xyz_W[4:].eq(0.0).all()


def test_only_rows_that_were_never_in_use_are_zero_already(generator):
    """Rows are dropped, partly used again, and the buffers grow: no moment and no coefficient of
    old rows is left."""
    model = GaussianModel(sh_degree=1)
    for n, kept in ((10, 4), (3, 7), (8, 2), (5000, 4999), (4, 1), (9000, 9000)):
        start = len(model)
        model.append(seeds(n, generator))
        assert model.params.sh[start:, 1:].eq(0.0).all()
        for moments in (model.moments.exp_avg, model.moments.exp_avg_sq):
            assert all(column[start:].eq(0.0).all() for column in vars(moments).values())
            for column in vars(moments).values():
                column.fill_(3.0)
        model.params.sh.fill_(3.0)
        model = GaussianModel.from_state_dict(model.state_dict()) if n == 8 else model
        model.keep(torch.arange(len(model)) < kept)


def test_a_derivative_asked_of_a_view_stays_with_that_view(generator):
    model = GaussianModel(0)
    model.append(seeds(3, generator))
    mine = model.params.xyz_W.requires_grad_()
    assert mine.requires_grad
    assert not model.params.xyz_W.requires_grad
    model.params.xyz_W.add_(1.0)
    assert torch.equal(mine.detach(), model.params.xyz_W)


def test_views_are_made_again_when_the_rows_change(generator):
    """Also where a map has as many rows as before, in another buffer."""
    model = GaussianModel(sh_degree=0)
    model.append(seeds(10, generator))
    before = model.params
    assert model.params is before
    assert model.moments.exp_avg is model.moments.exp_avg
    model.append(seeds(5000, generator))
    model.keep(torch.arange(5010) < 10)
    after = model.params
    assert after is not before
    after.xyz_W.zero_()
    assert model.state_dict()["rows"]["xyz_W"].eq(0).all()
    assert before.xyz_W.ne(0).any()


def test_activated_values(generator):
    model = GaussianModel(sh_degree=0)
    s = seeds(3, generator)
    model.append(s)
    torch.testing.assert_close(model.rgb, s.rgb)
    torch.testing.assert_close(model.opacity, s.opacity)
    assert PLY_BYTES * len(model) == 3 * 248
    assert "3 Gaussians" in repr(model)


def test_bad_arguments_are_sentences():
    with pytest.raises(ValueError, match="sh_degree must be 0, 1, 2 or 3, got 4"):
        GaussianModel(sh_degree=4)
    with pytest.raises(ValueError, match=r"rows must be \[0\], got \[2\]"):
        GaussianModel().keep(torch.ones(2, dtype=torch.bool))


@pytest.mark.parametrize(
    ("name", "value"),
    [("opacity", 3.0), ("scale_m", -0.1), ("xyz_W", float("nan"))],
)
def test_gaussians_that_are_not_numbers_are_refused(generator, name, value):
    new = seeds(5, generator)
    model = GaussianModel(sh_degree=0)
    getattr(new, name)[2] = value
    with pytest.raises(ValueError, match=rf"got .* as {name} of row 2"):
        model.append(new)
    assert len(model) == 0
