"""Which keyframes GPS-SLAM looks at again, and in which places of the round."""

from typing import Any

import pytest
import torch

from gsfusion_nb.config import BaseConfig, ScheduleConfig
from gsfusion_nb.data.room import room
from gsfusion_nb.mapping.gps_views import SurfaceKeyframe, ViewRound
from gsfusion_nb.optim import Keyframe, KeyframeList

FRAMES = room(n_frames=9, width=16, height=12)


class Keyframes(KeyframeList):
    """The first ``n`` frames of a walk, of which the first ones are drawn."""

    def __init__(self, n: int):
        super().__init__()
        self.n_drawn: list[int] = []
        for i in range(n):
            self.append(FRAMES[i])

    def draw(self, n: int, generator: Any) -> list[Keyframe]:
        self.n_drawn.append(n)
        return [self[i] for i in range(max(0, n))]


def look(keyframe: Keyframe) -> SurfaceKeyframe:
    return SurfaceKeyframe.of(keyframe, torch.zeros(6, 8, 3), torch.zeros(6, 8), BaseConfig())


def looked_at(views):
    return [view.keyframe.index for view in views.recalls]


def recall(views, keyframes, n, n_new):
    views.recall(keyframes, look, None, n, n_new)


@pytest.fixture
def views():
    return ViewRound(ScheduleConfig(keyframes=4))


def test_the_newest_but_one_comes_first_and_others_are_drawn(views):
    keyframes = Keyframes(6)
    recall(views, keyframes, 3, 1)
    assert looked_at(views) == [4, 0, 1]
    assert keyframes.n_drawn == [2]


def test_what_was_looked_at_is_not_new(views):
    recall(views, Keyframes(6), 1, 1)
    keyframes = Keyframes(6)
    recall(views, keyframes, 2, 1)
    assert keyframes.n_drawn == [2]
    assert looked_at(views) == [4, 0, 1]


def test_without_new_ones_all_are_drawn(views):
    keyframes = Keyframes(6)
    recall(views, keyframes, 2, 0)
    assert keyframes.n_drawn == [2]
    assert looked_at(views) == [0, 1]


def test_of_one_keyframe_the_newest_is_not_looked_at_as_new(views):
    keyframes = Keyframes(1)
    recall(views, keyframes, 1, 1)
    assert keyframes.n_drawn == [1]


def test_of_two_keyframes_the_first_is_new(views):
    recall(views, Keyframes(2), 1, 1)
    assert looked_at(views) == [0]


def test_a_view_keeps_one_place_and_the_oldest_give_way(views):
    recall(views, Keyframes(9), 4, 0)
    assert looked_at(views) == [0, 1, 2, 3]
    recall(views, Keyframes(9), 1, 0)
    assert looked_at(views) == [1, 2, 3, 0]
    recall(views, Keyframes(9), 1, 1)
    assert looked_at(views) == [2, 3, 0, 7]


def test_no_more_are_drawn_than_there_are_places(views):
    keyframes = Keyframes(9)
    recall(views, keyframes, 20, 1)
    assert keyframes.n_drawn == [3]
    assert looked_at(views) == [7, 0, 1, 2]
