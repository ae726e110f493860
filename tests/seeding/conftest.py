"""A few frames of the built-in room."""

import pytest

from gsfusion_nb.data.room import room
from gsfusion_nb.types import Frame


@pytest.fixture(scope="session")
def small_walk() -> list[Frame]:
    """Three frames of 80 x 60, close together."""
    scene = room(n_frames=240, width=80, height=60)
    return [scene[i] for i in range(3)]
