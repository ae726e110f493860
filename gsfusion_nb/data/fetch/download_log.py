"""Records of the downloaded files, with source and date: one JSON file beside the data sets, and one inside each."""

import json
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from ...files import write_file
from ...strict_json import read_json
from .checksum import digest

DOWNLOAD_LOG = "fetched.json"
"""In the folder of all data sets: every file that was ever downloaded."""
SOURCE = "source.json"
"""In each data set: the files it was made from, and its licence."""


@dataclass(frozen=True, kw_only=True)
class DownloadedFile:
    """One file that was downloaded."""

    url: str
    size: int
    sha256: str
    date: str
    """UTC, ISO 8601."""
    published: str = ""
    """The published digest it was compared with; empty if there is none."""

    @staticmethod
    def now(url: str, file: Path, published: str) -> "DownloadedFile":
        """Record of a file that was just downloaded."""
        return DownloadedFile(
            url=url,
            size=file.stat().st_size,
            sha256=digest(file).removeprefix("sha256:"),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            published=published,
        )


def read_download_log(folder: Path) -> list[DownloadedFile]:
    """The files downloaded so far; a list that cannot be read counts as empty."""
    try:
        return [DownloadedFile(**entry) for entry in read_json(folder / DOWNLOAD_LOG, "a list of files")]
    except (OSError, ValueError, TypeError):
        return []


def record(folder: Path, downloaded: DownloadedFile) -> str:
    """Add a file to the list. Returns a note if the same address gave a different file before, else ""."""
    entries = read_download_log(folder)
    earlier = [entry for entry in entries if entry.url == downloaded.url]
    same = [entry for entry in earlier if entry.sha256 == downloaded.sha256]
    if not same:
        write_file(folder / DOWNLOAD_LOG, _json([*map(asdict, entries), asdict(downloaded)]))
    if earlier and not same:
        return (
            f"{downloaded.url} has changed since {earlier[-1].date}: sha256 was {earlier[-1].sha256[:12]} and is now "
            f"{downloaded.sha256[:12]}; no digest is published"
        )
    return ""


def write_source(folder: Path, *, title: str, licence: str, cite: str, files: list[DownloadedFile]) -> None:
    """Write the data set's own record."""
    values = {"title": title, "licence": licence, "cite": cite, "files": [asdict(file) for file in files]}
    write_file(folder / SOURCE, _json(values))


def _json(values: object) -> str:
    return json.dumps(values, indent=1) + "\n"
