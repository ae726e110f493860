"""The worker thread: run, pause, step, stop, errors, and never two hands on the iterator."""

import threading
import time

import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.backends.choice import choice_of_block
from gsfusion_nb.viz import scrubber
from gsfusion_nb.viz.player import Player
from gsfusion_nb.viz.scrubber import Scrubber


class Work:
    """Counts to ``n``, remembering where it stands and which thread worked; may raise at a step."""

    def __init__(self, n=10, fail_at=None, pause_s=0.0):
        self.n = n
        self.fail_at = fail_at
        self.pause_s = pause_s
        self.done = 0
        self.threads = set()

    def steps(self):
        while self.done < self.n:
            time.sleep(self.pause_s)
            if self.done == self.fail_at:
                raise RuntimeError(f"broke at {self.done}")
            self.threads.add(threading.current_thread())
            self.done += 1
            yield self.done


def wait_for(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.002)


def test_start_runs_to_the_end_on_another_thread():
    work = Work()
    seen = []
    rests = []
    player = Player(
        work.steps,
        on_step=seen.append,
        on_rest=lambda: rests.append(player.state),
    )
    assert player.state == "ready"
    player.start()
    assert player.join(10)
    assert (player.state, player.n_steps, seen) == ("finished", 10, list(range(1, 11)))
    assert rests == ["finished"]
    assert threading.current_thread() not in work.threads
    player.start()  # nothing is left to do
    assert not player.is_alive


def test_step_does_one_and_several_add_up():
    work = Work()
    player = Player(work.steps)
    player.step()
    wait_for(lambda: player.state == "paused")
    assert work.done == 1
    player.step()
    player.step()
    wait_for(lambda: work.done == 3 and player.state == "paused")
    time.sleep(0.02)
    assert work.done == 3
    player.close()
    assert player.state == "stopped"
    assert not player.is_alive


def test_pause_holds_and_start_goes_on():
    work = Work(n=1000, pause_s=0.001)
    player = Player(work.steps)
    player.start()
    wait_for(lambda: work.done > 3)
    player.pause()
    wait_for(lambda: player.state == "paused")
    held = work.done
    time.sleep(0.05)
    assert work.done == held
    player.start()
    wait_for(lambda: work.done > held)
    player.close()
    assert player.state == "stopped"
    stopped = work.done
    player.start()
    wait_for(lambda: work.done > stopped)
    player.close()


def test_run_sync_works_here_and_takes_over_from_the_thread():
    work = Work(n=300, pause_s=0.0005)
    player = Player(work.steps)
    assert player.run_sync(3) == 3
    assert (player.state, work.done, work.threads) == ("paused", 3, {threading.current_thread()})
    player.start()
    wait_for(lambda: work.done > 5)
    player.run_sync()
    assert (player.state, work.done) == ("finished", 300)
    assert player.run_sync() == 0


def test_an_error_is_kept_and_the_work_can_go_on():
    work = Work(fail_at=4)
    rests = []
    player = Player(
        work.steps,
        on_rest=lambda: rests.append((player.state, str(player.error))),
    )
    player.start()
    assert player.join(10)
    assert rests == [("failed", "broke at 4")]
    work.fail_at = None
    player.start()
    assert player.join(10)
    assert (player.state, work.done, player.error) == ("finished", 10, None)


def test_the_lock_is_held_during_a_step():
    work = Work(n=50, pause_s=0.002)
    player = Player(work.steps)
    player.start()
    wait_for(lambda: work.done > 2)
    with player.lock:
        held = work.done
        time.sleep(0.03)
        assert work.done == held
    player.close()


def test_backend_and_threads_reach_the_worker():
    found = []

    def steps():
        found.append((choice_of_block.get(), torch.get_num_threads()))
        yield

    with use_backend("reference"):
        player = Player(steps)
        player.start()
        player.join(10)
    assert found == [("reference", torch.get_num_threads())]


def test_a_long_run_keeps_its_beginning_and_its_end(monkeypatch):
    monkeypatch.setattr(scrubber, "MOST_ENTRIES", 10)
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
    slider.go_to(99)
    assert shown[-1] == 99
    assert slider.following
