"""Chapter 10's checkers agree with the library, and the loop compiles as it stands."""

import inspect

import numpy as np
import torch
from numba import njit

from gsfusion_nb.compare.kernel_work import ADAM_FLOATS, ADAM_FLOPS
from gsfusion_nb.compare.roofline import Roofs
from gsfusion_nb.course import backends
from gsfusion_nb.tsdf import tsdf_update
from gsfusion_nb.viz.panels.stage_bars import sped_up


def test_amdahl_is_the_panels():
    seconds = {"tsdf": 0.02, "optimise": 0.05, "seeding": 0.004}
    by_panel = sum(seconds.values()) / sum(sped_up(seconds, {"optimise": 7.0}).values())
    assert abs(backends._speedup(seconds, "optimise", 7.0) - by_panel) < 1e-12


def test_the_roof_and_the_traffic_are_the_librarys():
    roofs = Roofs(gflops=80.0, gb_per_s=12.0)
    for intensity in (0.1, 6.0, 90.0):
        assert backends._attainable(intensity, 80.0, 12.0) == roofs.attainable_gflops(intensity)
    assert backends._adam_traffic(10) == (4 * ADAM_FLOATS * 10, ADAM_FLOPS / (4 * ADAM_FLOATS))


def test_the_loop_compiles_and_agrees_with_the_library():
    g = np.random.default_rng(0)
    D, d = (g.uniform(-1.5, 1.5, 500).astype(np.float32) for _ in range(2))
    d[::7] = np.nan
    W = g.integers(0, 8, 500).astype(np.float32)
    loop = inspect.unwrap(backends._average_loop)  # without the run-time type checks of the tests
    new_D, new_W = njit()(loop)(D, W, d, 5.0)
    t = [torch.from_numpy(a) for a in (D, W, d)]
    right_D, right_W = tsdf_update(*t, truncation_m=1.0, max_weight=5.0)
    np.testing.assert_allclose(new_D, right_D.numpy(), atol=1e-6)
    np.testing.assert_allclose(new_W, right_W.numpy())
