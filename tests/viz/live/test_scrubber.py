"""A slider back through what was shown."""

from gsfusion_nb.viz.live import player
from gsfusion_nb.viz.live.player import Scrubber


def test_a_long_run_keeps_its_beginning_and_its_end(monkeypatch):
    monkeypatch.setattr(player, "MOST_ENTRIES", 10)
    shown = []
    slider = Scrubber(shown.append, what="step", css_class="x")
    slider.show_newest()
    slider.go_to(3)
    assert shown == []
    for step in range(100):
        slider.add(step)
        slider.show_newest()
    assert shown == list(range(100))
    kept = slider.entries
    assert kept == sorted(set(kept))
    assert (kept[0], kept[-1]) == (0, 99)
    assert 5 <= len(kept) <= 10
    slider.go_to(0)
    assert shown[-1] == 0
    assert not slider.following
    slider.go_to(-1)
    assert shown[-1] == 99
    assert slider.following
