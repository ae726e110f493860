"""Every panel of the bench draws another picture at every move, or its row would time nothing."""

from typing import Any

import numpy as np
import pytest

from gsfusion_nb.compare.bench import BenchOptions, panels
from gsfusion_nb.data.room import room

SMALL_ROOM = room(n_frames=60, width=160, height=120)


@pytest.fixture
def small(monkeypatch):
    for name, count in (("ORBIT_GAUSSIANS", 300), ("MICROSCOPE_GAUSSIANS", 300), ("GRADIENT_GAUSSIANS", 100)):
        monkeypatch.setattr(panels, name, count)
    monkeypatch.setattr(panels, "_room", lambda: SMALL_ROOM)


@pytest.mark.parametrize("title", panels.PANELS)
def test_every_move_changes_the_picture(title, small):
    for method, move in panels.PANELS[title]().items():
        pictures = []
        for i in range(3):
            shown: Any = move(i)
            picture = shown.picture() if hasattr(shown, "picture") else shown
            pictures.append(picture.tobytes() if isinstance(picture, np.ndarray) else str(picture))
        assert pictures[0] != pictures[1] != pictures[2], method


def test_a_row_for_each_thing_that_is_shown(small):
    options = BenchOptions(what="panels", quick=True)
    case = next(case for case in panels.cases(options) if case.title == "colour ball")
    rows = list(case.run())
    assert [(row.section, row.case, row.method) for row in rows] == [("panels", "colour ball", "red")]
    assert rows[0].timing is not None
    assert rows[0].timing.runs == 3
    assert rows[0].timing.wall_ms > 0
