"""Shapes that the room's pictures are drawn with."""

import numpy as np

from gsfusion_nb.data.room.canvas import dot


def test_a_dot_lies_where_it_is_asked_for():
    image = np.zeros((60, 100, 3), np.uint8)
    dot(image, 0.25, 0.75, 0.05, (1.0, 0.5, 0.0))
    row, column = np.nonzero(image[..., 0])
    assert (row.mean(), column.mean()) == (45.0, 25.0)
    assert 2 * 5 <= column.max() - column.min() <= 2 * 5 + 2  # its edge is smoothed
    assert image[45, 25, 0] == 255
    assert image[..., 2].max() == 0
