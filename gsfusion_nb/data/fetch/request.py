"""One HTTP request: which addresses are allowed, where a redirect may lead, what the answer says about its body."""

import re
import urllib.error
import urllib.request
from dataclasses import dataclass
from email.message import Message
from email.utils import parsedate_to_datetime
from http.client import HTTPResponse
from urllib.parse import urljoin, urlsplit

from ...errors import shown
from .errors import DownloadError

MAX_REDIRECTS = 5


def check_address(url: str, *, before: str = "") -> None:
    """Raise ``DownloadError`` for an address that is not http or https, or that changes from https to http after
    ``before``."""
    parts = urlsplit(url)
    led = f"{before} redirects to {url}" if before else url
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise DownloadError(f"{led}: expected an http or https address")
    if before and urlsplit(before).scheme == "https" and parts.scheme == "http":
        raise DownloadError(f"{led}: expected https to stay https")


class _Redirects(urllib.request.HTTPRedirectHandler):
    max_redirections = MAX_REDIRECTS
    max_repeats = 2

    def http_error_302(self, req, fp, code, msg, headers):
        target = headers.get("location")
        if target:
            try:
                check_address(urljoin(req.full_url, target), before=req.full_url)
            except DownloadError:
                fp.close()
                raise
        return super().http_error_302(req, fp, code, msg, headers)

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        new = super().redirect_request(req, fp, code, msg, headers, newurl)
        if new is not None:
            new.method = req.get_method()  # otherwise a request for the size becomes a download
        return new

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302


def _opener() -> urllib.request.OpenerDirector:
    # Not build_opener: it also opens file:, ftp: and data: addresses.
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        _Redirects(),
    ):
        opener.add_handler(handler)
    opener.addheaders = [("User-Agent", "gsfusion-nb data scripts"), ("Accept-Encoding", "identity")]
    return opener


def request(url: str, *, timeout_s: float, start: int = 0, validator: str = "", method: str = "GET") -> HTTPResponse:
    """Ask for a file from byte ``start`` on, if its version is still ``validator``.

    Raises:
        DownloadError: an address or a redirect that is not allowed. urllib.error.HTTPError: a status other than
            success. OSError, http.client.HTTPException: the network.
    """
    check_address(url)
    asked = urllib.request.Request(url, method=method)
    if start:
        asked.add_header("Range", f"bytes={start}-")
        asked.add_header("If-Range", validator)
    try:
        return _opener().open(asked, timeout=timeout_s)
    except urllib.error.HTTPError as e:
        if 300 <= e.code < 400:
            e.close()
            raise DownloadError(
                f"{url} redirects more than {MAX_REDIRECTS} times, or nowhere (status {e.code})"
            ) from None
        raise


@dataclass(frozen=True, kw_only=True)
class Body:
    """What a response says about the file."""

    start: int
    """First byte of the file that the response contains."""
    total: int | None
    """Bytes of the whole file; None if the server does not report it."""
    validator: str
    """Strong entity tag, or date of the last change; empty if there is neither."""

    @staticmethod
    def of(response: HTTPResponse, url: str) -> "Body":
        """Raises ``DownloadError`` for an encoded body, a web page, or a range that makes no sense."""
        headers = response.headers
        encoding = headers.get("Content-Encoding", "identity")
        if encoding != "identity":
            raise DownloadError(f"{url} has the content encoding {encoding}; expected the file without encoding")
        if headers.get_content_type() == "text/html" and headers.get("Content-Type"):
            raise DownloadError(
                f"{url} is a web page; expected a file: has it moved, or does this network need a login?"
            )
        if response.status == 206:
            sent = headers.get("Content-Range", "")
            found = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+|\*)", sent.strip())
            if not found:
                raise DownloadError(
                    f"{url} answers a range request with Content-Range {shown(sent)}; expected the range of bytes"
                )
            total = None if found[3] == "*" else int(found[3])
            return Body(start=int(found[1]), total=total, validator=_validator(headers))
        return Body(start=0, total=_whole_number(headers.get("Content-Length")), validator=_validator(headers))


def retry_after_s(headers: Message, now_s: float) -> float | None:
    """Seconds the server asks to wait, from ``Retry-After``: a number or a date; None if the header is missing."""
    text = (headers.get("Retry-After") or "").strip()
    if text.isdigit():
        return float(text)
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - now_s)
    except (ValueError, TypeError):
        return None


def total_of_refused_range(headers: Message) -> int | None:
    """Size of the file as status 416 reports it in ``Content-Range: bytes */size``."""
    found = re.fullmatch(r"bytes \*/(\d+)", headers.get("Content-Range", "").strip())
    return int(found[1]) if found else None


def _validator(headers: Message) -> str:
    tag = headers.get("ETag", "").strip()
    if tag and not tag.startswith("W/"):
        return tag
    return headers.get("Last-Modified", "").strip()


def _whole_number(text: str | None) -> int | None:
    return int(text) if text and text.strip().isdigit() else None
