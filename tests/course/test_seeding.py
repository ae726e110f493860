"""Chapter 9's checkers agree with the library and with brute force."""

import torch

from gsfusion_nb.compare.page import pareto_front
from gsfusion_nb.course import cell_budget, check, seeding
from gsfusion_nb.seeding import check_rule


def test_the_budget_trees_error_is_the_sum_of_squares():
    image = cell_budget._busy_corner()
    error = cell_budget._squared_error_of(image)
    cell = image[3:10, 5:14].double()
    by_hand = float((cell - cell.mean(dim=(0, 1))).square().sum())
    assert abs(error(5, 3, 9, 7) - by_hand) < 1e-6 * by_hand


def test_more_cells_never_make_it_worse():
    image = cell_budget._busy_corner()
    error = cell_budget._squared_error_of(image)
    left = [
        sum(error(*c) for c in cell_budget._budget_cells(image, n)) for n in (1, 4, 16, 64, 256)
    ]
    assert left == sorted(left, reverse=True)
    whole = cell_budget._budget_cells(image, 10_000)
    assert len(whole) < 10_000  # cells of one pixel's width are not cut


def test_the_front_is_the_leaderboards():
    generator = torch.Generator().manual_seed(0)
    n = torch.randint(0, 9, (40,), generator=generator).float()
    db = torch.randint(0, 9, (40,), generator=generator).float()
    assert seeding._pareto(n, db).tolist() == pareto_front(n.numpy(), db.numpy()).tolist()


def test_the_solutions_are_rules():
    assert check_rule(seeding._raster).seeds["new"] > 0
    assert check_rule(seeding._where_empty).seeds["new"] > 0


def test_a_rule_that_returns_a_tensor_hears_what_is_missing():
    verdict = check.raster_rule(lambda ctx, *, step_px=8: torch.zeros(3))
    assert "it returns Seeds" in repr(verdict)


def test_cells_that_overlap_are_named():
    verdict = check.budget_cells(lambda rgb, n: [(0, 0, rgb.shape[1], rgb.shape[0])] * 4)
    assert "the cells tile the image" in repr(verdict)
