import threading

import pytest
import torch

from gsfusion_nb.data import BadFrameError
from gsfusion_nb.data.stream import POLICIES, Mailbox
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


def taken(box: Mailbox) -> list[int]:
    """Indices of all that is left."""
    found = []
    while True:
        try:
            item = box.get(0)
        except StopIteration:
            return found
        assert item is not None
        found.append(item.index)


def fill(box: Mailbox, indices) -> None:
    for i in indices:
        box.put(frame(i))


def index_of(item: Frame | None) -> int:
    assert item is not None
    return item.index


def test_a_queue_loses_its_oldest_and_counts_them():
    box = Mailbox("queue", 3)
    fill(box, range(8))
    box.end()
    assert taken(box) == [5, 6, 7]
    assert (box.n_received, box.n_dropped) == (8, 5)


def test_latest_holds_only_the_newest_whatever_size_is_asked_for():
    box = Mailbox("latest", 5)
    fill(box, range(4))
    assert index_of(box.get()) == 3
    fill(box, range(4, 7))
    box.end()
    assert taken(box) == [6]
    assert (box.n_received, box.n_dropped) == (7, 5)


def test_drop_loses_what_comes_while_one_waits_or_is_mapped():
    box = Mailbox("drop")
    fill(box, [0, 1])  # 1 comes while 0 waits
    assert index_of(box.get()) == 0
    fill(box, [2, 3])  # while 0 is mapped
    assert box.get(0) is None  # 0 is done, nothing waits
    fill(box, [4, 5])
    box.end()
    assert taken(box) == [4]
    assert (box.n_received, box.n_dropped) == (6, 4)


def test_all_makes_the_source_wait_and_loses_nothing():
    box, waiting = Mailbox("all", 2), threading.Event()
    fill(box, [0, 1])

    def put_more():
        waiting.set()
        fill(box, [2, 3])
        box.end()

    thread = threading.Thread(target=put_more)
    thread.start()
    waiting.wait(5)
    assert box.n_waiting == 2
    assert taken_until_end(box) == [0, 1, 2, 3]
    thread.join(5)
    assert not thread.is_alive()
    assert box.n_dropped == 0


def taken_until_end(box: Mailbox) -> list[int]:
    found = []
    while True:
        try:
            found.append(index_of(box.get(5)))
        except StopIteration:
            return found


@pytest.mark.parametrize("policy", POLICIES)
def test_errors_of_single_frames_keep_their_place_and_are_never_dropped(policy):
    box = Mailbox(policy, 2)
    box.put(frame(0))
    box.put_error(BadFrameError("frame 1 is torn"))
    assert index_of(box.get()) == 0
    with pytest.raises(BadFrameError, match="frame 1 is torn"):
        box.get()
    box.put(frame(2))
    box.end()
    assert taken(box) == [2]


def test_dropping_the_oldest_leaves_errors_in_place():
    box = Mailbox("queue", 1)
    box.put_error(BadFrameError("first"))
    fill(box, [1, 2])
    box.end()
    with pytest.raises(BadFrameError, match="first"):
        box.get()
    assert taken(box) == [2]


@pytest.mark.parametrize("policy", POLICIES)
def test_the_sources_exception_comes_after_its_frames_and_once(policy):
    box = Mailbox(policy, 2)
    box.put(frame(0))
    box.end(OSError("the disk is gone"))
    assert index_of(box.get()) == 0
    with pytest.raises(OSError, match="the disk is gone"):
        box.get()
    with pytest.raises(StopIteration):
        box.get()


def test_closing_frees_a_source_that_waits_for_room():
    box = Mailbox("all", 1)
    box.put(frame(0))
    thread = threading.Thread(target=fill, args=(box, [1, 2, 3]))
    thread.start()
    box.close()
    thread.join(5)
    assert not thread.is_alive()
    assert box.n_waiting == 0
    with pytest.raises(StopIteration):
        box.get()


def test_closing_frees_a_taker_that_waits_for_a_frame():
    box, ended = Mailbox(), threading.Event()

    def take():
        with pytest.raises(StopIteration):
            box.get()
        ended.set()

    thread = threading.Thread(target=take)
    thread.start()
    box.close()
    assert ended.wait(5)
    thread.join(5)


def test_impossible_mailboxes_are_refused():
    with pytest.raises(KeyError, match="no policy 'newest'; known: all, drop, latest, queue"):
        Mailbox("newest")
    with pytest.raises(ValueError, match="at least 1 frame, got 0"):
        Mailbox("queue", 0)
