"""All steps of fetching a data set: describe, ask, download, verify, unpack, convert, read; then the folder gets its
name."""

import contextlib
import hashlib
import logging
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ...progress import ProgressDisplay
from .archive.unpack import unpack
from .archive.unpacker import Limits
from .checksum import verify
from .disk import require_space
from .download import ReportProgress, Transfer, download, remote_size
from .download_log import DownloadedFile, record, write_source
from .errors import ArchiveError, ChecksumError, FetchError
from .plan import Item, Plan, agree, describe
from .work_folder import WORK, only_one, unfinished_folder

log = logging.getLogger(__name__)

LEAST_LIMIT_BYTES = 50_000_000
"""Lower bound of the size limits, because the stated size of a small file may be inexact."""


@dataclass(frozen=True, kw_only=True)
class FetchOptions:
    """Options that are the same for all data sets."""

    out: Path
    """Folder of all data sets."""
    yes: bool = False
    """The user agrees to download size and licence."""
    mirror: str = ""
    """Address of a host with the same paths, instead of the data set's own."""
    keep_archives: bool = False
    """Keep the downloaded files in ``.fetch``."""
    transfer: Transfer = field(default_factory=Transfer)
    say: Callable[[str], object] = lambda text: None
    """Called with messages for the user."""
    ask: Callable[[str], str] | None = None
    """Asks the user; None if no user is there."""


def fetch_data_set(plan: Plan, options: FetchOptions) -> Path:
    """Fetch a data set and return its folder.

    An existing data set is only read again. A broken download continues in the next run. The folder gets its name when
    it is complete and the reader has opened it.

    Raises:
        FetchError: or a subclass; the message says what to do.
    """
    out, target = options.out, options.out / plan.folder
    if target.exists():
        options.say(f"{target} already exists; nothing is fetched (remove or rename it to fetch it again).")
        _report(plan, target, target, options)
        return target
    sizes = [remote_size(item.url(options.mirror)) for item in plan.items]
    options.say(describe(plan, out, sizes, options.mirror))
    missing = sum(_missing(item, size, options) for size, item in zip(sizes, plan.items, strict=True))
    require_space(out, missing + plan.unpacked_bytes, f"{plan.folder}, its archives included,")
    agree(yes=options.yes, ask=options.ask)
    with only_one(out):
        return _make(plan, options, target)


def _make(plan: Plan, options: FetchOptions, target: Path) -> Path:
    work = options.out / WORK
    files = [(item, work / _file_name(item.url(options.mirror))) for item in plan.items]
    downloaded = [_fetch(plan, item, file, options) for item, file in files]
    with unfinished_folder(target, options.out) as folder:
        for item, file in files:
            _place(plan, item, file, folder)
        try:
            plan.convert(folder)
        except ArchiveError:  # an archive inside an archive
            for _, file in files:
                file.unlink(missing_ok=True)
            raise
        write_source(folder, title=plan.title, licence=plan.licence, cite=plan.cite, files=downloaded)
        _report(plan, folder, target, options)
    if not options.keep_archives:
        for _, file in files:
            file.unlink(missing_ok=True)
    return target


def _fetch(plan: Plan, item: Item, file: Path, options: FetchOptions) -> DownloadedFile:
    """Download a file and compare it; a file with another digest is downloaded once more."""
    url = item.url(options.mirror)
    for attempt in (1, 2):
        with _shown(file) as progress:
            download(url, file, max_bytes=_most(plan, item), transfer=options.transfer, progress=progress)
        if not item.checksum:
            break
        try:
            verify(file, item.checksum)
            break
        except ChecksumError as e:
            file.unlink()
            if attempt == 2:
                raise ChecksumError(f"{url}: {e} (twice, so a transmission error is unlikely)") from None
            options.say(f"{e}; it is downloaded once more.")
    downloaded = DownloadedFile.now(url, file, item.checksum)
    if note := record(options.out, downloaded):
        options.say(f"Note: {note}.")
    return downloaded


def _place(plan: Plan, item: Item, file: Path, folder: Path) -> None:
    if item.save_as:
        shutil.copyfile(file, folder / item.save_as)
        return
    limit = max(int(plan.most_growth * plan.unpacked_bytes), LEAST_LIMIT_BYTES)
    try:
        unpack(file, folder, choose=item.choose, limits=Limits(max_bytes=limit))
    except ArchiveError:
        file.unlink()  # the same file would fail again
        raise


def _report(plan: Plan, folder: Path, target: Path, options: FetchOptions) -> None:
    """Read every sequence in ``folder``, which is or will become ``target``, and print how to map it."""
    sequences = plan.sequences(folder)
    if not sequences:
        raise FetchError(f"{folder} holds no sequence")
    for sequence in sequences:
        options.say(f"{sequence.prove(folder)}\n  {sequence.command(target)}")


def _missing(item: Item, size: int | None, options: FetchOptions) -> int:
    """Bytes of a file that are not downloaded yet."""
    file = options.out / WORK / _file_name(item.url(options.mirror))
    part = file.with_name(file.name + ".part")
    if file.exists():
        return 0
    return max(0, (item.stated_bytes if size is None else size) - (part.stat().st_size if part.exists() else 0))


def _most(plan: Plan, item: Item) -> int:
    return max(int(plan.most_growth * item.stated_bytes), LEAST_LIMIT_BYTES)


def _file_name(url: str) -> str:
    """Name of a downloaded file: a digest of the address and its own name, because two hosts may use the same name."""
    return f"{hashlib.sha256(url.encode()).hexdigest()[:8]}-{url.rsplit('/', 1)[-1]}"


@contextlib.contextmanager
def _shown(file: Path) -> Iterator[ReportProgress]:
    with ProgressDisplay(file.name[9:], unit="B", leave=False) as display:
        yield lambda done, total: display.show(done, total=total)
