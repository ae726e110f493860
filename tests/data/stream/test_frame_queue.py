"""The queue of arriving frames, the thread that fills it, and selection."""

import threading
import weakref
from collections.abc import Iterator
from contextlib import closing

import pytest

from gsfusion_nb.backends import use_backend
from gsfusion_nb.backends.choice import choice_of_block
from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.data import BadFrameError, SequenceError, folder
from gsfusion_nb.data.stream import BackgroundFrames, LiveSource, SelectedFrames, read_ahead
from gsfusion_nb.types import Frame


def test_a_source_that_says_nothing_has_no_poses():
    """So that its poses, the identity, are never taken for measured ones."""
    assert not LiveSource.has_poses


def test_latest_holds_only_the_newest(sequence):
    given = threading.Event()

    def source() -> Iterator[Frame]:
        yield from (sequence[i] for i in range(3))
        given.set()

    frames = BackgroundFrames(source(), policy="latest")
    frames._thread.start()
    assert given.wait(5)
    assert [f.index for f in frames] == [2]
    assert (frames.n_received, frames.n_dropped) == (3, 2)


def test_all_makes_the_source_wait_and_loses_nothing(sequence):
    counting = Counting(sequence)
    with closing(BackgroundFrames(counting_frames(counting), size=2)) as frames:
        first = next(frames)
        assert [first.index, *(f.index for f in frames)] == 3 * [0, 1, 2, 3]
        assert (frames.n_received, frames.n_dropped) == (12, 0)
    assert counting.most_alive <= 6


def counting_frames(counting) -> Iterator[Frame]:
    for i in range(len(counting)):
        yield counting[i]


class Counting:
    """A sequence that remembers which frames were read, on which thread, and how many are alive."""

    def __init__(self, source, bad=()):
        self.source = source
        self.bad = set(bad)
        self.name = "counting"
        self.camera = source.camera
        self.read: list[int] = []
        self.threads: set[str] = set()
        self.alive: weakref.WeakSet = weakref.WeakSet()
        self.most_alive = 0

    def __len__(self):
        return 3 * len(self.source)

    def pose(self, i):
        return self.source.pose(i % len(self.source))

    def __getitem__(self, i):
        self.read.append(i)
        self.threads.add(threading.current_thread().name)
        if i in self.bad:
            raise BadFrameError(f"frame {i} is torn")
        frame = self.source[i % len(self.source)]
        self.alive.add(frame)
        self.most_alive = max(self.most_alive, len(self.alive))
        return frame


@pytest.fixture
def sequence(box, tmp_path):
    return folder(box.folder(tmp_path, 4))


def frames_of(frames) -> list[Frame | str]:
    """What comes, errors as their text."""
    found: list[Frame | str] = []
    while True:
        try:
            found.append(next(frames))
        except StopIteration:
            return found
        except SequenceError as e:
            found.append(str(e))


@pytest.mark.parametrize("depth", [0, 1, 4])
def test_reading_ahead_gives_the_same_frames_and_errors_in_order(sequence, depth):
    counting = Counting(sequence, bad={2, 7})
    found = frames_of(read_ahead(counting, depth=depth))
    assert [f if isinstance(f, str) else f.index for f in found] == [
        0,
        1,
        "frame 2 is torn",
        3,
        0,
        1,
        2,
        "frame 7 is torn",
        0,
        1,
        2,
        3,
    ]
    assert counting.threads == {"frames" if depth else "MainThread"}
    first = found[0]
    assert isinstance(first, Frame)
    assert (first.rgb == sequence[0].rgb).all()


def test_closing_early_ends_the_thread(sequence):
    frames = read_ahead(Counting(sequence), depth=1)
    next(frames)
    frames.close()
    assert "frames" not in {t.name for t in threading.enumerate()}
    with pytest.raises(StopIteration):
        next(frames)


def test_an_exception_of_the_source_is_raised_after_its_frames(sequence):
    def source() -> Iterator[Frame]:
        yield sequence[0]
        raise RuntimeError("the driver crashed")

    frames = BackgroundFrames(source())
    assert next(frames).index == 0
    with pytest.raises(RuntimeError, match="the driver crashed"):
        next(frames)
    assert frames_of(frames) == []


class Silent(LiveSource):
    """A camera that gives one frame and then waits until it is stopped."""

    def __init__(self, frame):
        self.frame = frame
        self.stopping = threading.Event()

    def __iter__(self):
        yield self.frame
        assert self.stopping.wait(10)

    def stop(self):
        self.stopping.set()


def test_a_source_that_waits_is_stopped(sequence):
    source = Silent(sequence[0])
    with closing(BackgroundFrames(source)) as frames:
        next(frames)
    assert source.stopping.is_set()
    assert "frames" not in {t.name for t in threading.enumerate()}


def test_the_chosen_backend_reaches_the_thread(sequence):
    seen = []

    class Asking(Counting):
        def __getitem__(self, i):
            seen.append(choice_of_block.get())
            return super().__getitem__(i)

    with use_backend("reference"), closing(read_ahead(Asking(sequence))) as frames:
        next(frames)
    assert seen[0] == "reference"


def test_selection_counts_arrivals_and_resizes(sequence):
    data = DataConfig(start=2, stride=3, stop=9, width=32, depth_max_m=10.0)
    found = list(
        SelectedFrames(
            (f for _ in range(3) for f in sequence),
            data,
            first_index=100,
        )
    )
    assert [f.index for f in found] == [102, 105, 108]
    assert [f.timestamp_s for f in found] == [sequence[i].timestamp_s for i in (2, 1, 0)]
    assert found[0].camera == sequence.camera.resized(32, 24)
    assert found[0].rgb.shape == (24, 32, 3)


def test_options_that_a_stream_cannot_have_are_refused(sequence):
    with pytest.raises(SequenceError, match=r"data\.stop must be above data\.start 4"):
        SelectedFrames(sequence, DataConfig(start=4, stop=2))
    with pytest.raises(SequenceError, match=r"data\.repair corrects recordings"):
        SelectedFrames(sequence, DataConfig(repair=RepairConfig(fx=3.0)))
    with pytest.raises(SequenceError, match="expected a Frame, got int"):
        next(SelectedFrames(iter([3]), DataConfig()))  # pyright: ignore[reportArgumentType]
