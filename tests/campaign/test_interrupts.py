"""A short campaign of interrupts; ``interrupts.py`` runs long ones."""

import interrupts
import pytest


@pytest.mark.slow
def test_ctrl_c_at_random_moments_changes_no_map():
    figures = interrupts.campaign(
        tries=6,
        seed=1,
        variants=list(interrupts.VARIANTS),
        most_s=0.5,
    )
    assert figures.interrupts > 20
    assert (figures.different, figures.others) == ([], [])
