"""What a live source is beyond an iterable of frames."""

import abc
from collections.abc import Iterator

from ...types import Frame
from .frame_queue import Policy


class LiveSource(abc.ABC):
    """Frames that arrive over time: iterate over it, from any thread; ``stop`` ends the iteration from another.

    A frame that cannot be used raises ``BadFrameError`` and the iteration can continue; other errors end it. A source
    that breaks off by itself (a camera that is unplugged) ends like one that is finished, and ``broke_off`` says why.
    """

    name: str = "stream"
    has_poses: bool = False
    """False: every pose is the identity, and a mapper has to track."""
    policy: Policy = "latest"
    """What to do by default when mapping is slower."""
    broke_off: str = ""
    """Why the source ended before its time, a sentence; empty if it did not."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[Frame]: ...

    @abc.abstractmethod
    def stop(self) -> None:
        """End the iteration soon, after the frame that is being read."""
