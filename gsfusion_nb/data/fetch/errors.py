"""Errors of fetching data; every message names the address or file."""

from ...errors import as_sentence


class FetchError(ValueError):
    """A data set could not be fetched or prepared."""

    def __str__(self) -> str:
        return as_sentence(super().__str__())


class DownloadError(FetchError):
    """The server sent no usable file, and an immediate second attempt would not help."""


class ChecksumError(FetchError):
    """A file differs from the published one."""


class ArchiveError(FetchError):
    """An archive is damaged, or holds something that must not be unpacked."""


class NoSpaceError(FetchError):
    """The disk is too full."""


class DeclinedError(FetchError):
    """The user did not agree to download size and licence."""
