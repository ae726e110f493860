"""Fetching public data sets: describe, ask, download, unpack, convert, read; then the folder gets
its name.

The scripts in ``data_scripts/`` list the files of each data set; the code that they share is here.
pooch downloads, compares digests and tries again; a download that is broken off begins anew.
"""

import argparse
import json
import logging
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..data.open import open_sequence
from ..errors import FORESEEN, crash_sentence
from ..files import atomic_folder, write_file
from .unpack import ArchiveError, Choose, FetchError, unpack

WORK = ".fetch"
"""Folder for downloads and unfinished data sets, in the folder of all data sets."""

SOURCE = "source.json"
"""In each data set: the files that it was made from, and its licence."""

ATTEMPTS = 5
"""Downloads of a file before one gives up."""

TIMEOUT_S = 60.0
"""Longest time without data from the server, seconds."""


@dataclass(frozen=True, kw_only=True)
class Item:
    """One file to download."""

    url: str
    stated_bytes: int
    """Published or estimated size."""
    checksum: str = ""
    """Published digest, ``algorithm:hexadecimal``."""
    choose: Choose = lambda name: name
    """Which members of the archive are unpacked, and to which paths."""
    save_as: str = ""
    """For a file that is not an archive: its path in the data set's folder."""


@dataclass(frozen=True, kw_only=True)
class SequenceOnDisk:
    """One sequence of a data set and its options."""

    path: str = "."
    """Folder inside the data set's folder."""
    preset: str
    reader: dict[str, Any] = field(default_factory=dict)
    """Options of the layout's reader."""

    def command(self, folder: Path) -> str:
        """The command that maps it."""
        words = ["gsfusion-nb", "map", str(folder / self.path), "--preset", self.preset]
        if self.reader:
            words += [
                "--reader",
                *(f"{name}={str(value).lower()}" for name, value in self.reader.items()),
            ]
        return shlex.join(words)

    def prove(self, folder: Path) -> str:
        """Open it and decode its first and last frame; returns a line that describes it.

        Raises:
            SequenceError: the reader refuses it.
        """
        sequence = open_sequence(folder / self.path, **self.reader)
        first = sequence[0]
        last = sequence[len(sequence) - 1]
        depth_m = first.depth_m[first.depth_m > 0]
        depth_share = float((last.depth_m > 0).float().mean())
        return (
            f"{sequence.name}: {len(sequence)} frames of "
            f"{first.camera.width}x{first.camera.height}, depth around "
            f"{float(depth_m.median()):.2f} m in the first, at {100 * depth_share:.0f} % of the "
            "pixels of the last"
        )


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A data set: its files, how they are processed, and its licence."""

    folder: str
    """Folder of the data set, inside the folder of all data sets."""
    title: str
    licence: str
    """The terms in a sentence."""
    cite: str
    items: Sequence[Item]
    unpacked_bytes: int
    """Approximate size on disk in the end."""
    sequences: Callable[[Path], list[SequenceOnDisk]]
    """The sequences in the finished folder, and how to map them."""
    convert: Callable[[Path], object] = lambda folder: None
    """How the unpacked files are processed."""
    note: str = ""
    """A sentence that helps the user to decide."""


def fetch_data_set(plan: Plan, out: Path) -> None:
    """Fetch a data set into ``out`` and print how to map it; an existing one is only read again.

    The folder gets its name when it is complete and the reader has opened it. Downloads are kept in
    ``out/.fetch``.

    Raises:
        FetchError: or a subclass; the message says what to do.
    """
    target = out / plan.folder
    if target.exists():
        _say(
            f"{target} already exists; nothing is fetched (remove or rename it to fetch it again)."
        )
        return _report(plan, target, target)
    with atomic_folder(target, out / WORK / "unfinished" / target.name) as folder:
        files = [(item, _download(item, out)) for item in plan.items]
        try:
            for item, file in files:
                if item.save_as:
                    shutil.copyfile(file, folder / item.save_as)
                else:
                    unpack(file, folder, choose=item.choose)
            plan.convert(folder)
        except ArchiveError:  # the same files would fail again
            for _, file in files:
                file.unlink(missing_ok=True)
            raise
        _write_source(plan, files, folder)
        _report(plan, folder, target)
    return None


def _described(plan: Plan, target: Path) -> str:
    """Contents, size and licence of a plan."""
    lines = [plan.title]
    for item in plan.items:
        check = (
            f"compared with its published {item.checksum.partition(':')[0]}"
            if item.checksum
            else "no checksum"
        )
        lines.append(f"  from     {item.url} (about {size_text(item.stated_bytes)}; {check})")
    lines += [
        f"  to       {target / plan.folder} (about {size_text(plan.unpacked_bytes)})",
        f"  licence  {plan.licence}",
        f"  cite     {plan.cite}",
    ]
    return "\n".join([*lines, f"  note     {plan.note}"] if plan.note else lines)


def _agree() -> None:
    """Return if the user agrees; raise ``FetchError`` if not, or if there is no user to ask."""
    if sys.stdin is None or not sys.stdin.isatty():
        raise FetchError(
            "cannot ask whether you agree to size and licence, because this is not a terminal; run "
            "again with --yes"
        )
    if input("Go on under this licence? [y/N] ").strip().lower() not in ("y", "yes"):
        raise FetchError("nothing was fetched")


def _download(item: Item, target: Path) -> Path:
    """The downloaded file of an item; one that is there already, with the published digest if any,
    is taken."""
    import pooch
    from requests.exceptions import RequestException

    pooch.get_logger().setLevel(logging.WARNING)
    name = item.url.rpartition("/")[2]
    store = pooch.create(
        target / WORK / "downloads",
        base_url="",
        registry={name: item.checksum or None},
        urls={name: item.url},
        retry_if_failed=ATTEMPTS - 1,
    )
    try:
        shows = sys.stderr is not None and sys.stderr.isatty()
        downloader: Any = pooch.HTTPDownloader(timeout=TIMEOUT_S, progressbar=shows)
        return Path(store.fetch(name, downloader=downloader))
    except (RequestException, ValueError) as e:
        raise FetchError(
            f"{item.url} could not be downloaded: {e}; {ATTEMPTS} attempts were made, run again "
            "later"
        ) from None


def _write_source(
    plan: Plan,
    files: list[tuple[Item, Path]],
    folder: Path,
) -> None:
    """Write the data set's own record: where its files come from, and its licence."""
    import pooch

    download_rows = [
        {"url": item.url, "sha256": pooch.file_hash(str(file)), "published": item.checksum}
        for item, file in files
    ]
    values = {
        "title": plan.title,
        "licence": plan.licence,
        "cite": plan.cite,
        "files": download_rows,
    }
    write_file(folder / SOURCE, json.dumps(values, indent=1) + "\n")


def _report(plan: Plan, folder: Path, target: Path) -> None:
    """Read every sequence in ``folder``, which is or will become ``target``, and print how to map
    it."""
    sequences = plan.sequences(folder)
    if not sequences:
        raise FetchError(f"{folder} holds no sequence")
    for sequence in sequences:
        _say(f"{sequence.prove(folder)}\n  {sequence.command(target)}")


def size_text(n_bytes: int) -> str:
    """A size as text, with 1 GB = 1,000 MB."""
    if n_bytes < 1_000_000:
        return f"{n_bytes / 1e3:.0f} kB" if n_bytes >= 1000 else f"{n_bytes} bytes"
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"


def run(
    description: str,
    plans: Callable[[str], Plan],
    names: Sequence[str],
    arguments: Sequence[str] | None = None,
) -> int:
    """The command line of a script: describe the data sets that are named, ask once, fetch them.

    Args:
        description: The script's docstring.
        plans: From a name to its plan.
        names: Names that can be given.
        arguments: Of the command line; None: those of the program.

    Returns:
        Exit status: 0 done, 1 an error (its message is printed), 130 interrupted.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="+", choices=names, help="which data sets")
    parser.add_argument(
        "--out", type=Path, default=Path("data"), help="folder of all data sets (default: data)"
    )
    parser.add_argument(
        "--yes", action="store_true", help="agree to download size and licence without a question"
    )
    parser.add_argument(
        "--keep-archives", action="store_true", help="keep the downloaded archives in OUT/.fetch"
    )
    options = parser.parse_args(arguments)
    try:
        wanted_plans = [plans(name) for name in dict.fromkeys(options.name)]
        missing = [plan for plan in wanted_plans if not (options.out / plan.folder).exists()]
        for plan in missing:
            _say(_described(plan, options.out))
        if missing and not options.yes:
            _agree()
        for plan in wanted_plans:
            fetch_data_set(plan, options.out)
        if not options.keep_archives:
            shutil.rmtree(options.out / WORK, ignore_errors=True)
    except Exception as e:
        text = (
            str(e) if isinstance(e, FORESEEN) else crash_sentence(e, "data_scripts", sys.argv[1:])
        )
        sys.stderr.write(f"{text}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; run the same command again\n")
        return 130
    return 0


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201
