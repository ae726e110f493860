"""Whether an image file is written completely."""

from pathlib import Path

from ...foreign import open_regular
from ..sequence import SequenceError

_END_MARKS = {b"\x89PNG\r\n\x1a\n": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
"""First bytes of PNG and JPEG files, and the mark that ends them (PNG, W3C 2003, 11.2.5; JPEG, ITU-T T.81, B.1.1.3)."""

_TAIL_BYTES = 64
"""Some programs write a few bytes after the mark."""


def is_complete_image(path: Path) -> bool:
    """False for a missing or empty file, and for a PNG or JPEG without its end mark.

    Decoders fill the missing part of such a file with grey or black instead of failing. For other formats only the
    beginning is checked.
    """
    try:
        with open_regular(path, "an image") as file:
            head = file.read(8)
            size = file.seek(0, 2)
            file.seek(max(0, size - _TAIL_BYTES))
            tail = file.read()
    except (OSError, SequenceError):
        return False
    for first, last in _END_MARKS.items():
        if head.startswith(first):
            return last in tail
    return len(head) == 8
