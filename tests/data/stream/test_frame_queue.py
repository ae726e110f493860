import threading

import pytest
import torch

from gsfusion_nb.data import BadFrameError
from gsfusion_nb.data.stream import POLICIES, FrameQueue
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(width=2, height=2, fx=2.0, fy=2.0, cx=1.0, cy=1.0)


def frame(i: int) -> Frame:
    return Frame(
        index=i,
        timestamp_s=float(i),
        rgb=torch.zeros(2, 2, 3),
        depth_m=torch.ones(2, 2),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def taken(queue: FrameQueue) -> list[int]:
    """Indices of all that is left."""
    found = []
    while True:
        try:
            item = queue.get(0)
        except StopIteration:
            return found
        assert item is not None
        found.append(item.index)


def fill(queue: FrameQueue, indices) -> None:
    for i in indices:
        queue.put(frame(i))


def index_of(item: Frame | None) -> int:
    assert item is not None
    return item.index


def test_a_queue_loses_its_oldest_and_counts_them():
    queue = FrameQueue("queue", 3)
    fill(queue, range(8))
    queue.end()
    assert taken(queue) == [5, 6, 7]
    assert (queue.n_received, queue.n_dropped) == (8, 5)


def test_latest_holds_only_the_newest_whatever_size_is_asked_for():
    queue = FrameQueue("latest", 5)
    fill(queue, range(4))
    assert index_of(queue.get()) == 3
    fill(queue, range(4, 7))
    queue.end()
    assert taken(queue) == [6]
    assert (queue.n_received, queue.n_dropped) == (7, 5)


def test_drop_loses_what_comes_while_one_waits_or_is_mapped():
    queue = FrameQueue("drop")
    fill(queue, [0, 1])  # 1 comes while 0 waits
    assert index_of(queue.get()) == 0
    fill(queue, [2, 3])  # while 0 is mapped
    assert queue.get(0) is None  # 0 is done, nothing waits
    fill(queue, [4, 5])
    queue.end()
    assert taken(queue) == [4]
    assert (queue.n_received, queue.n_dropped) == (6, 4)


def test_all_makes_the_source_wait_and_loses_nothing():
    queue, waiting = FrameQueue("all", 2), threading.Event()
    fill(queue, [0, 1])

    def put_more():
        waiting.set()
        fill(queue, [2, 3])
        queue.end()

    thread = threading.Thread(target=put_more)
    thread.start()
    waiting.wait(5)
    assert queue.n_waiting == 2
    assert taken_until_end(queue) == [0, 1, 2, 3]
    thread.join(5)
    assert not thread.is_alive()
    assert queue.n_dropped == 0


def taken_until_end(queue: FrameQueue) -> list[int]:
    found = []
    while True:
        try:
            found.append(index_of(queue.get(5)))
        except StopIteration:
            return found


@pytest.mark.parametrize("policy", POLICIES)
def test_errors_of_single_frames_keep_their_place_and_are_never_dropped(policy):
    queue = FrameQueue(policy, 2)
    queue.put(frame(0))
    queue.put_error(BadFrameError("frame 1 is torn"))
    assert index_of(queue.get()) == 0
    with pytest.raises(BadFrameError, match="frame 1 is torn"):
        queue.get()
    queue.put(frame(2))
    queue.end()
    assert taken(queue) == [2]


def test_dropping_the_oldest_leaves_errors_in_place():
    queue = FrameQueue("queue", 1)
    queue.put_error(BadFrameError("first"))
    fill(queue, [1, 2])
    queue.end()
    with pytest.raises(BadFrameError, match="first"):
        queue.get()
    assert taken(queue) == [2]


@pytest.mark.parametrize("policy", POLICIES)
def test_the_sources_exception_comes_after_its_frames_and_once(policy):
    queue = FrameQueue(policy, 2)
    queue.put(frame(0))
    queue.end(OSError("the disk is gone"))
    assert index_of(queue.get()) == 0
    with pytest.raises(OSError, match="the disk is gone"):
        queue.get()
    with pytest.raises(StopIteration):
        queue.get()


def test_closing_frees_a_source_that_waits_for_room():
    queue = FrameQueue("all", 1)
    queue.put(frame(0))
    thread = threading.Thread(target=fill, args=(queue, [1, 2, 3]))
    thread.start()
    queue.close()
    thread.join(5)
    assert not thread.is_alive()
    assert queue.n_waiting == 0
    with pytest.raises(StopIteration):
        queue.get()


def test_closing_frees_a_taker_that_waits_for_a_frame():
    queue, ended = FrameQueue(), threading.Event()

    def take():
        with pytest.raises(StopIteration):
            queue.get()
        ended.set()

    thread = threading.Thread(target=take)
    thread.start()
    queue.close()
    assert ended.wait(5)
    thread.join(5)


def test_impossible_queues_are_refused():
    with pytest.raises(KeyError, match="no policy 'newest'; known: all, drop, latest, queue"):
        FrameQueue("newest")
    with pytest.raises(ValueError, match="at least 1 frame, got 0"):
        FrameQueue("queue", 0)
