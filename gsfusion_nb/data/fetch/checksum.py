"""Digests of files, written ``algorithm:hexadecimal`` as in ``md5:9e107d9d372bb6826bd81d3542a419d6``."""

import hashlib
import hmac
from pathlib import Path

from ...errors import shown
from ...foreign import open_regular
from .errors import ChecksumError

ALGORITHMS = ("md5", "sha1", "sha256", "sha512")


def digest(path: Path, algorithm: str = "sha256") -> str:
    """``algorithm:hexadecimal`` of a file's bytes."""
    with open_regular(path, "a downloaded file") as file:
        return f"{algorithm}:{hashlib.file_digest(file, algorithm).hexdigest()}"


def verify(path: Path, expected: str) -> None:
    """Compare a file with its published digest.

    Raises:
        ChecksumError: it differs. ValueError: ``expected`` is not a digest of a known algorithm.
    """
    algorithm, _, published = expected.partition(":")
    if algorithm not in ALGORITHMS or len(published) != 2 * hashlib.new(algorithm).digest_size:
        raise ValueError(f"expected algorithm:hexadecimal with one of {', '.join(ALGORITHMS)}, got {shown(expected)}")
    found = digest(path, algorithm)
    if not hmac.compare_digest(found, f"{algorithm}:{published.lower()}"):
        raise ChecksumError(
            f"{path.name} has {found}, but the published one is {expected}: the file is damaged or another one"
        )
