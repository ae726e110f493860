"""Kinds of values: what a type checker would say, said at run time to those who use none."""

from dataclasses import dataclass, field
from typing import Literal

import pytest

from gsfusion_nb.config import from_dict, replace, to_dict
from gsfusion_nb.config.values import Settings, positive, within


@dataclass(frozen=True, kw_only=True)
class Inner(Settings):
    sizes: tuple[int, ...] = within((1, 2), 1)
    share: float | None = positive(0.5)


@dataclass(frozen=True, kw_only=True)
class Group(Settings, group="group"):
    word: Literal["left", "right"] = "left"
    count: int = 3
    switch: bool = False
    rate: float = 0.1
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ({"word": "rihgt"}, "group.word must be one of left, right, got 'rihgt'"),
        ({"count": 2.5}, "group.count must be a whole number, got 2.5"),
        ({"count": True}, "group.count must be a whole number, got True"),
        ({"switch": 1}, "group.switch must be True or False, got 1"),
        ({"switch": "no"}, "group.switch must be True or False, got 'no'"),
        ({"inner": {"sizes": [3, 0]}}, "sizes must be >= 1, got 0"),
        ({"inner": {"share": -0.5}}, "share must be > 0, got -0.5"),
    ],
)
def test_wrong_kinds_are_refused(override, message):
    with pytest.raises(ValueError, match=message):
        from_dict(Group, override)


def test_layers_of_settings():
    base = from_dict(Group, {"count": 5, "inner": {"sizes": [4, 4]}})
    assert base.inner.sizes == (4, 4)
    layered = from_dict(Group, {"inner": {"share": None}}, start=base)
    assert (layered.count, layered.inner) == (5, Inner(sizes=(4, 4), share=None))
    assert to_dict(layered)["inner"] == {"sizes": (4, 4), "share": None}
    assert replace(layered, inner__share=0.2).inner.share == 0.2
    with pytest.raises(
        ValueError, match=r"inner: unknown keys \['size'\]; known: \['share', 'sizes'\]"
    ):
        replace(layered, inner__size=1)
