"""Errors of a recording and of its frames: readers and mappers raise them, the loop of a run decides what follows."""


class SequenceError(ValueError):
    """A file or folder that was given, or what was asked of it, makes no sense; one sentence that names the file."""


class SequenceNotFoundError(SequenceError, FileNotFoundError):
    """A folder or file that the sequence needs is not there."""


class BadFrameError(SequenceError):
    """One frame cannot be used (damaged image, no depth, invalid pose, tracking lost); the next frame may be fine."""
