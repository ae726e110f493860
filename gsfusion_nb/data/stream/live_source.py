"""The protocol of live sources: an iterable of frames that can be stopped."""

import abc
from collections.abc import Iterator

from ...types import Frame
from .frame_queue import Policy


class LiveSource(abc.ABC):
    """Frames that arrive over time: iterate over it, from any thread; ``stop`` ends the iteration from another.

    A frame that cannot be used raises ``BadFrameError`` and the iteration can continue; other errors end it. A source
    that is interrupted (a camera that is unplugged) ends like a finished one, and ``broke_off`` says why.
    """

    name: str = "stream"
    has_poses: bool = False
    """False: every pose is the identity, and the mapper must track."""
    policy: Policy = "latest"
    """Default policy for frames that arrive faster than they are mapped."""
    broke_off: str = ""
    """Why the source ended too early, as a sentence; empty if it did not."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[Frame]: ...

    @abc.abstractmethod
    def stop(self) -> None:
        """End the iteration after the frame that is being read."""
