"""The whole way of a data set, and what is left where it stops."""

import dataclasses
import hashlib
import importlib.util
import json
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from gsfusion_nb.data.fetch import (
    ArchiveError,
    ChecksumError,
    DeclinedError,
    DownloadError,
    FetchError,
    FetchOptions,
    Item,
    NoSpaceError,
    Plan,
    SequenceOnDisk,
    fetch_data_set,
)
from gsfusion_nb.data.fetch.checksum import digest, verify
from gsfusion_nb.data.fetch.download_log import read_download_log
from gsfusion_nb.data.fetch.plan import agree, describe, duration_text
from gsfusion_nb.data.fetch.work_folder import only_one

_spec = importlib.util.spec_from_file_location("hostile", Path(__file__).with_name("conftest.py"))
assert _spec is not None
assert _spec.loader is not None
hostile = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(hostile)


@pytest.fixture
def job(site, tmp_path, box, archives, transfer):
    """A data set in the plain layout behind a server, a plan for it, and options that agree."""
    source = box.folder(tmp_path / "source")
    files = {f"scan/{p.relative_to(source)}": p.read_bytes() for p in source.rglob("*") if p.is_file()}
    site.files["/set/scan.zip"] = archives.zip(files)
    return Job(site, tmp_path / "data", files, transfer, archives)


class Job:
    """What the tests turn."""

    def __init__(self, site, out, files, transfer, archives):
        self.site, self.out, self.files, self.archives = site, out, files, archives
        self.said: list[str] = []
        self.options = FetchOptions(out=out, yes=True, transfer=transfer, say=self.said.append)
        self.plan = Plan(
            folder="sets/scan",
            title="A scan",
            licence="Free to test.",
            cite="Nobody 2020.",
            items=[Item(base=f"{site.address}/set", path="scan.zip", stated_bytes=10_000, choose=self.choose)],
            unpacked_bytes=20_000,
            sequences=lambda folder: [SequenceOnDisk(preset="replica")],
        )

    def choose(self, name: str) -> str:
        return name.removeprefix("scan/")

    def with_item(self, **changes) -> Plan:
        return dataclasses.replace(self.plan, items=[dataclasses.replace(self.plan.items[0], **changes)])

    def nothing_looks_whole(self) -> bool:
        return not (self.out / "sets" / "scan").exists() and not (self.out / ".fetch/unfinished/scan").exists()


def test_the_whole_way(job):
    md5 = "md5:" + hashlib.md5(job.site.files["/set/scan.zip"]).hexdigest()
    folder = fetch_data_set(job.with_item(checksum=md5), job.options)
    assert folder == job.out / "sets" / "scan"
    for name, content in job.files.items():
        assert (folder / job.choose(name)).read_bytes() == content
    text = "\n".join(job.said)
    for part in ("A scan", "Free to test.", "Nobody 2020.", "compared with its published md5", "at 100 Mbit/s"):
        assert part in text
    assert job.said[-1].splitlines()[0].startswith("scan: 4 frames of 64x48, depth around ")
    assert job.said[-1].splitlines()[1] == f"  gsfusion-nb map {folder} --preset replica"
    source = json.loads((folder / "source.json").read_text())
    assert source["licence"] == "Free to test."
    (entry,) = read_download_log(job.out)
    assert source["files"] == [dataclasses.asdict(entry)]
    assert (entry.published, entry.size) == (md5, len(job.site.files["/set/scan.zip"]))
    assert entry.sha256 == hashlib.sha256(job.site.files["/set/scan.zip"]).hexdigest()
    assert [p.name for p in (job.out / ".fetch").iterdir() if p.is_file()] == ["lock"]  # the archive is gone


def test_a_second_time_nothing_is_asked(job):
    fetch_data_set(job.plan, job.options)
    job.site.seen.clear()
    fetch_data_set(job.plan, dataclasses.replace(job.options, yes=False))
    assert job.site.seen == []
    assert "already exists; nothing is fetched" in job.said[-2]


def test_archives_are_kept_on_request_and_used_again(job):
    options = dataclasses.replace(job.options, keep_archives=True)
    folder = fetch_data_set(job.plan, options)
    shutil.rmtree(folder)
    job.site.seen.clear()
    fetch_data_set(job.plan, options)
    assert job.site.ranges() == []


def test_agreement(job):
    nobody = dataclasses.replace(job.options, yes=False)
    with pytest.raises(
        DeclinedError, match=r"cannot ask whether you agree to size and licence, .*run again with --yes"
    ):
        fetch_data_set(job.plan, nobody)
    with pytest.raises(DeclinedError, match="nothing was fetched"):
        fetch_data_set(job.plan, dataclasses.replace(nobody, ask=lambda question: ""))
    assert job.site.ranges() == []  # only the size was asked for
    fetch_data_set(job.plan, dataclasses.replace(nobody, ask=lambda question: "Yes"))

    def gone(question):
        raise EOFError

    with pytest.raises(DeclinedError):
        agree(yes=False, ask=gone)


def test_corrupted_once_and_always(job):
    path, content = "/set/scan.zip", job.site.files["/set/scan.zip"]
    plan = job.with_item(checksum="md5:" + hashlib.md5(content).hexdigest())
    job.site.faults = {path: [hostile.corrupt]}
    with pytest.raises(ChecksumError, match=r"scan\.zip has md5:.*, but the published one is md5:.*twice"):
        fetch_data_set(plan, job.options)
    assert job.nothing_looks_whole()
    assert job.site.ranges() == [None, None]
    job.site.faults = {path: [hostile.corrupt, None]}
    fetch_data_set(plan, job.options)
    assert any("it is downloaded once more" in text for text in job.said)


def test_too_short_by_a_lie_is_found_in_the_archive(job):
    job.site.faults = {"/set/scan.zip": [hostile.shorter]}
    with pytest.raises(ArchiveError, match="damaged"):
        fetch_data_set(job.plan, job.options)
    assert job.nothing_looks_whole()
    job.site.faults = {}
    fetch_data_set(job.plan, job.options)  # the bad archive was not kept


def test_another_file_at_the_same_address_is_told(job):
    folder = fetch_data_set(job.plan, job.options)
    shutil.rmtree(folder)
    job.site.files["/set/scan.zip"] = job.archives.zip(job.files | {"scan/readme": b"new"})
    fetch_data_set(job.plan, job.options)
    assert any("has changed since 20" in text for text in job.said)
    assert len(read_download_log(job.out)) == 2


@pytest.mark.parametrize(
    ("add", "error"),
    [
        ({"../outside": b"x"}, "is outside the target folder"),
        ({"/outside": b"x"}, "absolute path"),
        ({"scan/bomb": bytes(90_000_000)}, "decompression bomb"),
        ({"scan/RGB/x": b""}, "the same name on some systems"),
    ],
)
def test_hostile_archive(job, add, error):
    job.site.files["/set/scan.zip"] = job.archives.zip(job.files | add)
    with pytest.raises(ArchiveError, match=error):
        fetch_data_set(job.plan, job.options)
    assert job.nothing_looks_whole()
    assert not (job.out / "outside").exists()


def test_a_set_that_cannot_be_read_never_gets_its_name(job):
    job.site.files["/set/scan.zip"] = job.archives.zip({k: v for k, v in job.files.items() if "poses" not in k})
    with pytest.raises(FetchError, match=r"cannot be read as a sequence: .* lacks poses\.txt"):
        fetch_data_set(job.plan, job.options)
    assert job.nothing_looks_whole()


def test_interrupted_while_unpacking(job):
    def interrupt(folder):
        assert (folder / "poses.txt").exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch_data_set(dataclasses.replace(job.plan, convert=interrupt), job.options)
    assert job.nothing_looks_whole()
    job.site.seen.clear()
    fetch_data_set(job.plan, job.options)
    assert job.site.ranges() == []  # the archive was whole


def test_broken_download_goes_on_in_the_next_run(job):
    job.site.faults = {"/set/scan.zip": [hostile.cut(5000)]}
    with pytest.raises(DownloadError, match="5 kB are kept; run again to continue"):
        fetch_data_set(job.plan, job.options)
    assert job.nothing_looks_whole()
    job.site.faults, job.site.seen = {}, []
    fetch_data_set(job.plan, job.options)
    assert job.site.ranges() == ["bytes=5000-"]


def test_disk_space_is_asked_for_first(job, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage(10**9, 10**9, 100_000_000))
    with pytest.raises(NoSpaceError, match="has 100 MB free; sets/scan, its archives included, needs"):
        fetch_data_set(job.plan, job.options)
    assert job.site.ranges() == []


def test_one_at_a_time(job):
    with only_one(job.out), pytest.raises(FetchError, match="another program is fetching into"):
        fetch_data_set(job.plan, job.options)
    fetch_data_set(job.plan, job.options)


def test_mirror(job):
    options = dataclasses.replace(job.options, mirror=job.site.address + "/set/")
    fetch_data_set(job.with_item(base="http://nowhere.invalid"), options)


def test_digests(tmp_path):
    (tmp_path / "x").write_bytes(b"The quick brown fox jumps over the lazy dog")
    assert digest(tmp_path / "x", "md5") == "md5:9e107d9d372bb6826bd81d3542a419d6"
    verify(tmp_path / "x", "md5:9E107D9D372BB6826BD81D3542A419D6")
    verify(tmp_path / "x", "sha256:d7a8fbb307d7809469ca9abcb0082e4f8d5651e46d3cdb762d02d0bf37c9e592")
    with pytest.raises(ChecksumError, match="the file is damaged or another one"):
        verify(tmp_path / "x", "md5:" + "0" * 32)
    for wrong in ("9e107d9d372bb6826bd81d3542a419d6", "md5:123", "crc:12345678"):
        with pytest.raises(ValueError, match="expected algorithm:hexadecimal"):
            verify(tmp_path / "x", wrong)


def test_texts(job):
    assert [duration_text(s) for s in (0.1, 80.0, 600.0, 9000.0)] == ["1 s", "80 s", "10 min", "2.5 h"]
    text = describe(job.plan, Path("data"), [None])
    assert "scan.zip (10 kB, estimated; no checksum public)" in text
    sequence = SequenceOnDisk(path="seq 01", preset="tum", format="seven_scenes", reader={"register": True})
    expected = "gsfusion-nb map 'data/chess/seq 01' --preset tum --format seven_scenes --reader register=true"
    assert sequence.command(Path("data/chess")) == expected
