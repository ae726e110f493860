"""Fitting single images: what the numbers are, and the finding of Fig. 7."""

import pytest

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping.fit_image import fit_image


@pytest.fixture(scope="module")
def frame():
    return open_sequence("room", data=DataConfig(width=160, height=120, hold_out_every=0))[10]


def test_disc_depth_needs_fewer_gaussians_for_the_same_median_depth_error(frame):
    few = fit_image(frame, 1000, "disc", steps=60)
    many = fit_image(frame, 2000, "blended", steps=60)
    assert few["median depth error, cm"] < many["median depth error, cm"]


def test_unknown_method_is_refused(frame):
    with pytest.raises(KeyError, match="flat"):
        fit_image(frame, 10, "flat")
