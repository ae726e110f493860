"""Live views without a browser: buttons, panels, curves, errors; of mapping, and of a loop."""

import time

import cv2
import numpy as np

from gsfusion_nb.drawing.pictures import error_map
from gsfusion_nb.viz import LiveLoop, LiveMapper
from gsfusion_nb.viz.mapped_frame import captions_of, live_panels, mosaic


def decoded(data):
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]


def shown_frame(live):
    """Which frame of the sequence the first panel looks like."""
    shown = decoded(live.images["input"].value).astype(int)
    return int(
        np.argmin([np.abs(shown - f.rgb.numpy() * 255).mean() for f in live.run.sequence.mapping])
    )


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def test_panels_show_the_frame_the_map_the_error_and_the_seeds(make_run):
    run = make_run()
    report = next(run.online())
    frame = run.sequence.mapping[0]
    panels = live_panels(run.mapper, frame)
    assert {p.shape for p in panels.values()} == {(36, 48, 3)}
    assert (panels["input"] == (frame.rgb.numpy() * 255 + 0.5).astype(np.uint8)).all()
    assert (panels["error"] == error_map(panels["render"], panels["input"])).all()
    red = (panels["quadtree_seeds"] == (255, 48, 64)).all(-1)
    assert report.n_seeds / 4 < red.sum() <= 4 * report.n_seeds
    assert mosaic(panels, captions_of(run.mapper)).shape[1] == 2 * 48 + 6


def test_run_sync_draws_the_last_frame_and_counts(make_run):
    run = make_run()
    live = LiveMapper(run)
    assert live.run_sync(2) == 2
    assert shown_frame(live) == 1
    live.run_sync()
    assert len(run.steps) == 6
    assert live.progress.value == live.progress.max == 6
    assert "finished" in live.status.value
    assert "6 of 6 frames" in live.status.value
    assert "GSFusion (measured" in live.status.value
    assert live.scrubber.widget.max == 5
    live.scrubber.widget.value = 5
    assert shown_frame(live) == 5


def test_the_slider_goes_back_through_all_frames(make_run):
    run = make_run(n=12)
    live = LiveMapper(run)
    assert live.scrubber.widget.disabled
    live.run_sync(8)
    assert (live.scrubber.widget.value, shown_frame(live)) == (7, 7)
    live.scrubber.widget.value = 2
    assert shown_frame(live) == 2
    assert "looking back at frame 2" in live.status.value
    live.run_sync(1)
    assert (live.scrubber.widget.max, live.scrubber.widget.value, shown_frame(live)) == (8, 2, 2)
    live.scrubber.widget.value = 8
    live.run_sync(1)
    assert (live.scrubber.widget.value, shown_frame(live)) == (9, 9)


def test_an_error_is_shown_in_the_widget_and_nothing_is_printed(make_run, capsys):
    live = LiveMapper(make_run(broken=(3,)))
    live.player.start()
    assert live.player.join(20)
    assert live.player.state == "failed"
    assert "RuntimeError: the film tore at frame 3" in live.error.value
    assert "<details" in live.error.value
    assert len(live.run.steps) == 3
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_another_live_mapper_stops_the_first(make_run):
    first = LiveMapper(make_run(n=2000))
    first.player.start()
    wait_for(lambda: first.run.steps)
    LiveMapper(make_run())
    assert first.player.join(10)
    assert len(first.run.steps) < 2000


def listen(viewer, monkeypatch):
    """Somebody looks at the viewer; how many rows the map had at each message."""
    monkeypatch.setattr("gsfusion_nb.viz.splat_viewer.MIN_INTERVAL_S", 0.0)
    sizes = []
    monkeypatch.setattr(
        viewer, "send", lambda content, buffers=(): sizes.append(content["head"]["n"])
    )
    viewer._on_message(viewer, {"kind": "ready"}, [])
    return sizes


def test_the_splat_viewer_follows_the_map_and_knows_its_time(make_run, monkeypatch):
    run = make_run(n=8, step_m=0.5)
    live = LiveMapper(run)
    viewer = live.splats(width=96)
    assert (viewer.width, viewer.height) == (96, 72)
    # nothing is mapped yet: where the camera will start
    assert viewer.T_WC.equal(run.sequence.mapping[0].T_WC)
    sizes = listen(viewer, monkeypatch)
    live.run_sync(1)
    wait_for(lambda: sizes and sizes[-1] == len(run.mapper.gaussians))
    first = viewer.birth_range
    live.player.start()
    assert live.player.join(20)
    wait_for(lambda: sizes[-1] == len(run.mapper.gaussians))
    assert sizes == sorted(sizes)
    assert first == [0.0, 0.0]
    assert viewer.birth_range == [0.0, float(run.mapper.gaussians.birth_frame.max())]
    assert viewer.birth_range[1] > 0
    viewer.T_WC = run.sequence.mapping[7].T_WC
    viewer.born_until = 0.0
    early = viewer.picture()
    viewer.born_until = None
    assert (viewer.picture() != early).any()


def test_it_starts_where_the_first_keyframe_was_and_the_last_viewer_follows(make_run):
    live = LiveMapper(make_run())
    live.run_sync(2)
    earlier = live.splats()
    viewer = live.splats(colour_by="depth", T_WC=live.run.sequence.mapping[3].T_WC)
    assert earlier.T_WC.equal(live.run.mapper.keyframes[0].T_WC)
    assert viewer.T_WC.equal(live.run.sequence.mapping[3].T_WC)
    assert live.viewer is viewer
    assert viewer.colour_by == "depth"


class Counting:
    """Counts to ``n``; the picture gets brighter; ``broken`` is the step that raises."""

    def __init__(self, n=6, broken=None):
        self.n = n
        self.broken = broken
        self.done = 0
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
    work = Counting(**options)
    return work, LiveLoop(
        work.steps,
        work.picture,
        {"count": work.values},
        n_steps=work.n,
        width=240,
    )


def test_run_sync_then_buttons_go_on():
    work, loop = make_loop()
    assert loop.run_sync(2) == 2
    assert "<b>paused</b> · step 2 of 6" in loop.status.value
    before = loop.images["image"].value
    loop.buttons["Step"].click()
    wait_for(lambda: work.done == 3 and loop.player.state == "paused")
    loop.buttons["Start"].click()
    wait_for(lambda: loop.player.state == "finished")
    assert loop.player.join(10)
    assert work.done == 6
    assert "<b>finished</b> · step 6 of 6" in loop.status.value
    assert loop.images["image"].value != before
