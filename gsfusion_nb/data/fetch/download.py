"""Downloading one file: a broken transfer continues where it stopped; the file gets its name when it is complete.

It uses only the standard library: pooch, which is installed with PyVista, restarts a broken transfer from the
beginning.
"""

import http.client
import json
import logging
import ssl
import time
import urllib.error
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from ...files import move_into_place, write_file
from ...strict_json import read_json
from .disk import full_disk, require_space, size_text
from .errors import DownloadError
from .request import Body, request, retry_after_s, total_of_refused_range

log = logging.getLogger(__name__)

BLOCK_BYTES = 1 << 20
TRY_AGAIN = (408, 425, 429, 500, 502, 503, 504)
"""Status codes after which another attempt may succeed."""

ReportProgress = Callable[[int, int | None], None]
"""Called with the bytes received and the total, where known."""


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Time limits and attempts of a download."""

    timeout_s: float = 60.0
    """Longest time without data from the server, seconds."""
    attempts: int = 6
    """Attempts in a row without a new byte before the download fails."""
    attempts_in_all: int = 500
    """Attempts at one file in total."""
    first_wait_s: float = 2.0
    """Wait after the first failure, seconds; doubled after each."""
    longest_wait_s: float = 120.0
    """Longest wait, including one that the server asks for, seconds."""
    slowest_bytes_per_s: float = 500.0
    """Fewer bytes than this during ``timeout_s`` count as no data."""
    sleep: Callable[[float], object] = time.sleep


class _TryAgain(Exception):
    """The transfer broke; another attempt may continue."""

    def __init__(self, reason: str, wait_s: float | None = None):
        super().__init__(reason)
        self.wait_s = wait_s


@dataclass(frozen=True)
class _Partial:
    """What is known about a partial file; stored beside it."""

    url: str
    validator: str
    total: int | None

    @staticmethod
    def load(path: Path) -> "_Partial | None":
        try:
            return _Partial(**read_json(path, "the state of a download", at_most=1_000_000))
        except (OSError, ValueError, TypeError):
            return None

    def save(self, path: Path) -> None:
        write_file(path, json.dumps(asdict(self)))


def download(
    url: str,
    path: Path,
    *,
    max_bytes: int,
    transfer: Transfer | None = None,
    progress: ReportProgress = lambda done, total: None,
) -> None:
    """Fetch ``url`` to ``path``; an existing file is not changed.

    Until it is complete it is stored as ``<name>.part`` with ``<name>.part.json``. A transfer continues only if the
    server gives the file's version (entity tag or date) and it has not changed; otherwise it starts again.

    Args:
        url: http or https address.
        path: File to write.
        max_bytes: A larger file is refused.
        transfer: Time limits and attempts.
        progress: Called after every block.

    Raises:
        DownloadError: the server refuses, sends something else than it announced, or does not answer. NoSpaceError: the
            disk is too full.
    """
    transfer = transfer or Transfer()
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    job = _Job(url, path, max_bytes, transfer, progress)
    farthest, fruitless = 0, 0
    for _ in range(transfer.attempts_in_all):
        try:
            job.attempt()
            move_into_place(job.part, path)
            job.note.unlink(missing_ok=True)
            return
        except _TryAgain as e:
            reached = job.size()
            fruitless = 0 if reached > farthest else fruitless + 1
            farthest = max(farthest, reached)
            if fruitless >= transfer.attempts:
                kept = f"; {size_text(reached)} are kept; run again to continue" if reached else ""
                raise DownloadError(f"{url}: {e}; gave up after {fruitless} attempts in a row{kept}") from None
            wait_s = e.wait_s if e.wait_s is not None else transfer.first_wait_s * 2.0**fruitless
            wait_s = min(wait_s, transfer.longest_wait_s)
            log.warning("%s: %s; again in %.0f s", path.name, e, wait_s)
            transfer.sleep(wait_s)
    raise DownloadError(f"{url}: the transfer broke {transfer.attempts_in_all} times; run again to continue")


@dataclass(frozen=True)
class _Job:
    url: str
    path: Path
    max_bytes: int
    transfer: Transfer
    progress: ReportProgress

    @property
    def part(self) -> Path:
        return self.path.with_name(self.path.name + ".part")

    @property
    def note(self) -> Path:
        return self.path.with_name(self.path.name + ".part.json")

    def size(self) -> int:
        return self.part.stat().st_size if self.part.exists() else 0

    def discard(self) -> None:
        self.part.unlink(missing_ok=True)
        self.note.unlink(missing_ok=True)

    def attempt(self) -> None:
        """One request; returns when the file is complete."""
        known = _Partial.load(self.note)
        if known is None or known.url != self.url or not known.validator:
            self.discard()
            known = None
        start = self.size()
        if known is not None and start and start == known.total:
            return
        validator = known.validator if known else ""
        try:
            with request(self.url, timeout_s=self.transfer.timeout_s, start=start, validator=validator) as response:
                body = Body.of(response, self.url)
                start = self._begin(body, start, known)
                total = known.total if known is not None and start and body.total is None else body.total
                self._receive(response, start, total)
        except urllib.error.HTTPError as e:
            with e:
                raise self._refused(e, start, known) from None
        except urllib.error.URLError as e:
            if isinstance(e.reason, ssl.SSLCertVerificationError):
                raise DownloadError(f"{self.url}: the server's certificate is not valid ({e.reason})") from None
            raise _TryAgain(f"no connection ({e.reason})") from None
        except TimeoutError:
            raise _TryAgain(f"the server sent nothing for {self.transfer.timeout_s:g} s") from None
        except (ConnectionError, http.client.HTTPException, ssl.SSLError) as e:
            raise _TryAgain(f"the connection broke ({type(e).__name__})") from None
        except OSError as e:
            if e.filename is not None:  # an error of the local file, not of the network
                raise full_disk(e, self.part) or e from None
            raise _TryAgain(f"the network failed ({e.strerror})") from None

    def _begin(self, body: Body, start: int, known: _Partial | None) -> int:
        """Position in the file where the body's bytes belong; the file is truncated to it."""
        if known is not None and body.start:
            # A server may omit what the request already contained.
            changed = body.validator not in ("", known.validator)
            changed |= None not in (body.total, known.total) and body.total != known.total
            if body.start != start or changed:
                self.discard()
                raise _TryAgain("the file on the server has changed, so the download starts again")
        elif body.start:
            raise DownloadError(f"{self.url} sends the file from byte {body.start} on; expected it from the beginning")
        if body.total is not None and body.total > self.max_bytes:
            raise DownloadError(f"{self.url} is {size_text(body.total)}; expected at most {size_text(self.max_bytes)}")
        require_space(self.path.parent, (body.total or 0) - body.start, self.path.name)
        if not body.start:
            self.part.write_bytes(b"")
            _Partial(self.url, body.validator, body.total).save(self.note)
        return body.start

    def _receive(self, response: http.client.HTTPResponse, start: int, total: int | None) -> None:
        done, window, since = start, start, time.monotonic()
        with self.part.open("ab") as file:
            while block := response.read1(BLOCK_BYTES):
                done += len(block)
                if done > self.max_bytes:
                    raise DownloadError(
                        f"{self.url} sends more than {size_text(self.max_bytes)}; it is not the expected file"
                    )
                try:
                    file.write(block)
                except OSError as e:
                    raise full_disk(e, self.part) or DownloadError(f"{self.part} cannot be written: {e}") from None
                self.progress(done, total)
                now = time.monotonic()
                if now - since > self.transfer.timeout_s:
                    if done - window < self.transfer.slowest_bytes_per_s * (now - since):
                        raise _TryAgain(f"only {done - window} bytes came in {now - since:.0f} s")
                    window, since = done, now
        if total is not None and done != total:
            raise _TryAgain(f"the connection ended after {done} of {total} bytes")

    def _refused(self, error: urllib.error.HTTPError, start: int, known: _Partial | None) -> Exception:
        if error.code == 416 and known is not None:
            self.discard()
            total = total_of_refused_range(error.headers)
            if total == start:
                return DownloadError(
                    f"{self.url} has {total} bytes, but the server announced {known.total} before; run again"
                )
            return _TryAgain("the server refuses to continue, so the download starts again")
        if error.code not in TRY_AGAIN:
            gone = ": it may have moved; is there a mirror (--mirror)?" if error.code in (404, 410) else ""
            return DownloadError(f"{self.url}: the server answers {error.code} {error.reason}{gone}")
        wait_s = retry_after_s(error.headers, time.time())
        if wait_s is not None and wait_s > self.transfer.longest_wait_s:
            return DownloadError(
                f"{self.url}: the server is busy and asks to come back in {wait_s:.0f} s; run again then"
            )
        return _TryAgain(f"the server answers {error.code} {error.reason}", wait_s)


def remote_size(url: str, *, timeout_s: float = 10.0) -> int | None:
    """Bytes of a file as its server reports them, or None if it does not answer. Nothing is downloaded."""
    try:
        with request(url, timeout_s=timeout_s, method="HEAD") as response:
            return Body.of(response, url).total
    except (DownloadError, OSError, http.client.HTTPException):
        return None
