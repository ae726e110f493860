"""A live loop without a browser: buttons, curves, errors, stored picture."""

import time

import numpy as np
import pytest

from gsfusion_nb.viz import LiveLoop


class Work:
    """Counts to ``n``; the picture gets brighter; ``broken`` is the step that raises."""

    def __init__(self, n=6, broken=None):
        self.n, self.broken, self.done = n, broken, 0
        self.values = []

    def steps(self):
        while self.done < self.n:
            self.done += 1
            if self.done == self.broken:
                raise RuntimeError("a hair in the gate")
            self.values.append(float(self.done))
            yield self.done

    def picture(self):
        return np.full((40, 60, 3), 10 * self.done, np.uint8)


def make_loop(**options):
    work = Work(**options)
    return work, LiveLoop(work.steps, work.picture, {"count": work.values}, n_steps=work.n, width=240)


def until(condition, seconds=10):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_run_sync_then_buttons_go_on():
    work, loop = make_loop()
    assert loop.run_sync(2) == 2
    assert "<b>paused</b> · step 2 of 6" in loop.status.value
    before = loop.image.value
    loop.buttons["Step"].click()
    until(lambda: work.done == 3 and loop.player.state == "paused")
    loop.buttons["Start"].click()
    until(lambda: loop.player.state == "finished")
    assert loop.player.join(10)
    assert work.done == 6
    assert "<b>finished</b> · step 6 of 6" in loop.status.value
    assert loop.image.value != before


def test_stop_and_start_go_on_where_it_stood():
    work, loop = make_loop(n=400)
    loop.buttons["Start"].click()
    until(lambda: work.done > 3)
    loop.buttons["Stop"].click()
    assert loop.player.join(10)
    stood = work.done
    assert stood < 400
    loop.run_sync(1)
    assert work.done == stood + 1


def test_an_error_is_shown_and_not_printed():
    _, loop = make_loop(broken=3)
    loop.buttons["Start"].click()
    until(lambda: "a hair in the gate" in loop.status.value)
    assert loop.player.state == "failed"
    with pytest.raises(RuntimeError, match="hair"):
        make_loop(broken=1)[1].run_sync()


def test_the_stored_picture_has_the_curves_below(monkeypatch):
    monkeypatch.setenv("GSNB_VIEW", "static")
    _, loop = make_loop()
    loop.run_sync()
    assert loop.picture().shape[0] > 40
    assert set(loop._repr_mimebundle_()[0]) == {"image/jpeg", "text/plain"}
