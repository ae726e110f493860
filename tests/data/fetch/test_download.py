"""Downloading from a server that misbehaves: what arrives is the file, or a sentence says why not."""

import hashlib
import importlib.util
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from gsfusion_nb.data.fetch.download import Transfer, download, remote_size
from gsfusion_nb.data.fetch.errors import DownloadError, NoSpaceError

_spec = importlib.util.spec_from_file_location("hostile", Path(__file__).with_name("conftest.py"))
assert _spec is not None
assert _spec.loader is not None
hostile = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(hostile)

FILE = b"".join(hashlib.sha256(bytes([i])).digest() for i in range(100))  # 3200 bytes
PATH = "/set/file.zip"

# what the server does, request by request; what came of it: a part of the error, or "" for the file; the ranges asked
# for; the bytes kept for the next run
CASES = {
    "well-behaved": ([None], "", [None], 0),
    "cut after 1000 bytes": ([hostile.cut(1000), None], "", [None, "bytes=1000-"], 0),
    "cut three times": (
        [hostile.cut(1000), hostile.cut(1500), hostile.cut(3000), None],
        "",
        [None, "bytes=1000-", "bytes=1500-", "bytes=3000-"],
        0,
    ),
    "cut always at 1000": (
        [hostile.cut(1000)],
        "the connection ended after 1000 of 3200 bytes; gave up after 3 attempts in a row; 1 kB are kept",
        [None, *["bytes=1000-"] * 3],
        1000,
    ),
    "cut, then ignores the range": ([hostile.cut(1000), hostile.no_ranges], "", [None, "bytes=1000-"], 0),
    "never the second half, ignores ranges": (
        [hostile.no_ranges_cut],
        "ended after 1600 of 3200 bytes; gave up after 3",
        [None, *["bytes=1600-"] * 3],
        1600,
    ),
    "cut, then another range than asked": (
        [hostile.cut(1000), hostile.wrong_place, None],
        "",
        [None, "bytes=1000-", None],
        0,
    ),
    "a range nobody asked for": ([hostile.wrong_place], "sends the file from byte 1 on", [None], 0),
    "cut, then 416": ([hostile.cut(1000), hostile.status(416), None], "", [None, "bytes=1000-", None], 0),
    "stalls after 1000 bytes": ([hostile.stall(1000), None], "", [None, "bytes=1000-"], 0),
    "stalls always": (
        [hostile.stall(1000)],
        "the server sent nothing for 0.4 s; gave up after 3 attempts in a row; 1 kB are kept",
        [None, *["bytes=1000-"] * 3],
        1000,
    ),
    "promises 10 bytes too many": (
        [hostile.longer],
        "has 3200 bytes, but the server announced 3210 before",
        [None, "bytes=3200-"],
        0,
    ),
    "cut inside a chunk": ([hostile.chunked_cut, None], "", [None, "bytes=1000-"], 0),
    "no length, whole": ([hostile.unsized], "", [None], 0),
    "no length, no end": ([hostile.endless], "sends more than 1 MB; it is not the expected file", [None], None),
    "redirect to the file": ([hostile.redirect("/other")], "", [None, None], 0),
    "redirect to file://": ([hostile.redirect("file:///etc/passwd")], "redirects to file:///etc/passwd", [None], 0),
    "redirect to ftp://": (
        [hostile.redirect("ftp://host/x")],
        "redirects to ftp://host/x: expected an http",
        [None],
        0,
    ),
    "redirect to data:": ([hostile.redirect("data:,x")], "redirects to data:,x: expected an http", [None], 0),
    "redirect without end": ([hostile.redirect(PATH)], "redirects more than 5 times", [None] * 3, 0),
    "redirect to nowhere": ([hostile.status(302)], "redirects more than 5 times, or nowhere", [None], 0),
    "404": ([hostile.status(404)], "answers 404 Not Found: it may have moved", [None], 0),
    "403": ([hostile.status(403)], "answers 403 Forbidden", [None], 0),
    "500 once": ([hostile.status(500), None], "", [None, None], 0),
    "500 always": ([hostile.status(500)], "answers 500 Internal Server Error; gave up after 3", [None] * 3, 0),
    "503, come back in 7 s": ([hostile.status(503, Retry_After="7"), None], "", [None, None], 0),
    "503, come back in an hour": (
        [hostile.status(503, Retry_After="3600")],
        "is busy and asks to come back in 3600 s",
        [None],
        0,
    ),
    "a login page": ([hostile.web_page], "is a web page; expected a file: has it moved", [None], 0),
    "a compressed transfer": ([hostile.encoded], "has the content encoding gzip", [None], 0),
}


@pytest.mark.parametrize("case", CASES)
def test_hostile_server(case, site, tmp_path, transfer):
    faults, error, ranges, kept = CASES[case]
    site.files = {PATH: FILE, "/other": FILE}
    site.faults = {PATH: list(faults)}
    target = tmp_path / "deep" / "file.zip"
    fetch = lambda: download(site.address + PATH, target, max_bytes=1_000_000, transfer=transfer)  # noqa: E731
    if error:
        with pytest.raises(DownloadError) as caught:
            fetch()
        assert error in str(caught.value)
        assert not target.exists()  # never half a file under its name
        part = target.with_name("file.zip.part")
        assert kept is None or (part.stat().st_size if part.exists() else 0) == kept
    else:
        fetch()
        assert target.read_bytes() == FILE
        assert [p.name for p in target.parent.iterdir()] == ["file.zip"]
    assert site.ranges() == ranges


def test_an_interrupted_download_goes_on_in_the_next_run(site, tmp_path, transfer):
    site.files = {PATH: FILE}
    site.faults = {PATH: [hostile.cut(2000)]}
    with pytest.raises(DownloadError):
        download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    site.faults, site.seen = {}, []
    heard = []
    download(
        site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer, progress=lambda *n: heard.append(n)
    )
    assert site.ranges() == ["bytes=2000-"]
    assert heard[-1] == (3200, 3200)
    assert (tmp_path / "x").read_bytes() == FILE
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert len(site.seen) == 1  # whole: nobody was asked again


def test_a_file_that_changes_between_attempts_starts_anew(site, tmp_path, transfer):
    site.files = {PATH: FILE}

    def change(handler, content):
        site.files[PATH] = FILE[::-1]
        handler.send(site.files[PATH])

    site.faults = {PATH: [hostile.cut(1000), change, None]}
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert (tmp_path / "x").read_bytes() == FILE[::-1]
    assert site.ranges() == [None, "bytes=1000-"]


def test_a_server_that_ignores_if_range_cannot_mix_two_versions(site, tmp_path, transfer):
    new = FILE[::-1] + b"more"

    def careless(handler, content):
        site.files[PATH] = new
        handler.head(206, len(new) - 1000, Content_Range=f"bytes 1000-{len(new) - 1}/{len(new)}")
        handler.wfile.write(new[1000:])

    site.files, site.faults = {PATH: FILE}, {PATH: [hostile.cut(1000), careless, None]}
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert (tmp_path / "x").read_bytes() == new


def test_an_answer_to_a_range_may_leave_out_version_and_size(site, tmp_path, transfer):
    def terse(handler, content):
        handler.head(206, len(content) - 1000, ETag="", Content_Range=f"bytes 1000-{len(content) - 1}/*")
        handler.wfile.write(content[1000:2000])

    site.files, site.faults = {PATH: FILE}, {PATH: [hostile.cut(1000), terse, None]}
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert (tmp_path / "x").read_bytes() == FILE
    assert site.ranges() == [None, "bytes=1000-", "bytes=2000-"]


def test_without_a_version_nothing_is_continued(site, tmp_path, transfer):
    site.files, site.tagged = {PATH: FILE}, False
    site.faults = {PATH: [hostile.cut(1000), None]}
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert (tmp_path / "x").read_bytes() == FILE
    assert site.ranges() == [None, None]


def test_waits_grow_and_the_servers_wish_counts(site, tmp_path, transfer, waits):
    site.files = {PATH: FILE}
    site.faults = {PATH: [hostile.status(500), hostile.status(503, Retry_After="7"), None]}
    download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert waits == [4.0, 7.0]


def test_a_drip_counts_as_silence(site, tmp_path, waits):
    site.files, site.faults = {PATH: FILE}, {PATH: [hostile.drip]}
    slow = Transfer(timeout_s=0.3, attempts=1, sleep=waits.append)
    with pytest.raises(DownloadError, match=r"only \d+ bytes came in 0 s; gave up"):
        download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=slow)


def test_no_server(tmp_path, transfer, site):
    with pytest.raises(DownloadError, match=r"no connection .* gave up after 3 attempts in a row$"):
        download("http://127.0.0.1:9/file", tmp_path / "x", max_bytes=10, transfer=transfer)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://host/file", "data:,x", "/etc/passwd", "http://"])
def test_addresses_that_are_no_web_addresses(url, tmp_path):
    with pytest.raises(DownloadError, match="expected an http or https address"):
        download(url, tmp_path / "x", max_bytes=10)


def test_a_redirect_must_not_give_up_https():
    from gsfusion_nb.data.fetch.request import check_address

    check_address("https://b/x", before="https://a/x")
    with pytest.raises(DownloadError, match="expected https to stay https"):
        check_address("http://b/x", before="https://a/x")


def test_larger_than_planned(site, tmp_path, transfer):
    site.files = {PATH: FILE}
    with pytest.raises(DownloadError, match="is 3 kB; expected at most 1 kB"):
        download(site.address + PATH, tmp_path / "x", max_bytes=1000, transfer=transfer)


def test_disk_full_before_and_during(site, tmp_path, transfer, monkeypatch):
    site.files = {PATH: FILE}
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage(10**9, 10**9, 1000))
    with pytest.raises(NoSpaceError, match=r"has 1 kB free; x needs 3 kB, and 200 MB must stay free"):
        download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    monkeypatch.undo()
    monkeypatch.setenv("no_proxy", "*")
    opened = Path.open

    class Full:
        def __init__(self, file):
            self.file = file

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self.file.close()

        def write(self, block):
            raise OSError(28, "No space left on device")

    def full(self, mode="r", *args, **options):
        file = opened(self, mode, *args, **options)
        return Full(file) if mode == "ab" else file

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(NoSpaceError, match=r"the disk is full: .*x\.part could not be written completely"):
        download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert not (tmp_path / "x").exists()


def test_a_folder_that_cannot_be_written_is_no_network_trouble(site, tmp_path, transfer, waits):
    site.files = {PATH: FILE}
    (tmp_path / "x.part").mkdir()
    with pytest.raises(OSError, match=r"x\.part"):
        download(site.address + PATH, tmp_path / "x", max_bytes=10_000, transfer=transfer)
    assert waits == []


def test_remote_size(site):
    site.files = {PATH: FILE}
    assert remote_size(site.address + PATH) == 3200
    assert remote_size(site.address + "/nothing") is None
    assert remote_size("http://127.0.0.1:9/file") is None
    assert remote_size("file:///etc/passwd") is None
    site.moved["/old"] = PATH
    assert remote_size(site.address + "/old") == 3200
    site.moved["/old"] = "file:///etc/passwd"
    assert remote_size(site.address + "/old") is None
    assert site.ranges() == []  # nothing was fetched
