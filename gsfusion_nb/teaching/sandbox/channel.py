"""Messages with a length in front, over a socket."""

import socket
import struct
import time

from .codec import LARGEST_BYTES


class ChannelClosed(ConnectionError):
    """The other side has gone."""


class TooSlow(TimeoutError):
    """No whole message came in time."""


class TooLarge(ValueError):
    """A message is announced that is larger than allowed."""


def send(to: socket.socket, message: bytes) -> None:
    """Send one message.

    Raises:
        ChannelClosed: the other side has gone.
    """
    try:
        to.sendall(struct.pack(">Q", len(message)) + message)
    except TimeoutError:
        raise TooSlow from None
    except OSError as e:
        raise ChannelClosed(str(e)) from None


def receive(source: socket.socket, *, until: float | None = None, largest: int = LARGEST_BYTES) -> bytes:
    """The next message.

    Args:
        until: Time of ``time.monotonic`` at which waiting ends; without it, never.
        largest: Most bytes of a message.

    Raises:
        ChannelClosed, TooSlow, TooLarge
    """
    (length,) = struct.unpack(">Q", _exactly(source, 8, until))
    if length > largest:
        raise TooLarge(f"{length} bytes")
    return _exactly(source, length, until)


def _exactly(source: socket.socket, count: int, until: float | None) -> bytes:
    parts = bytearray()
    while len(parts) < count:
        left = None if until is None else until - time.monotonic()
        if left is not None and left <= 0:
            raise TooSlow
        source.settimeout(left)
        try:
            part = source.recv(min(count - len(parts), 1 << 20))
        except TimeoutError:
            raise TooSlow from None
        except OSError as e:
            raise ChannelClosed(str(e)) from None
        if not part:
            raise ChannelClosed
        parts += part
    return bytes(parts)
