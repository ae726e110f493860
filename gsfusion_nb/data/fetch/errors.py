"""What can go wrong while data are fetched; every message is a sentence that names the address or file."""


class FetchError(ValueError):
    """A data set could not be fetched or prepared."""


class DownloadError(FetchError):
    """The server gave no usable file, and trying again at once would not help."""


class ChecksumError(FetchError):
    """A file is not the one that was published."""


class ArchiveError(FetchError):
    """An archive is damaged, or holds something that must not be unpacked."""


class NoSpaceError(FetchError):
    """The disk is too full."""


class DeclinedError(FetchError):
    """Nobody agreed to the size and the licence."""
