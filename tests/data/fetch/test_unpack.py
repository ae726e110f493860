"""Unpacking archives that mean harm."""

import bz2
import gzip
import io
import shutil
import stat
import tarfile
import zipfile
from collections import namedtuple
from pathlib import Path

import pytest

from gsfusion_nb.data.fetch import ArchiveError, Limits, NoSpaceError, unpack

LIMITS = Limits(max_bytes=10_000_000)
GOOD = {"set/a.txt": b"a" * 100, "set/deep/b.bin": bytes(range(256)), "set/empty": b""}


def bad_names():
    """Name of a member -> what is said about it."""
    return {
        "../outside": "is outside the target folder",
        "set/../../outside": "is outside the target folder",
        "..\\outside": "is outside the target folder",
        "/etc/outside": "absolute path",
        "C:\\outside": "absolute path",
        "c:outside": "absolute path",
        "\\\\server\\share": "absolute path",
        "set/a\nb": "a name that is invalid on some operating systems",
        "set/NUL.txt": "a name that is invalid on some operating systems",
        "set/dot.": "a name that is invalid on some operating systems",
        "set/stream:x": "a name that is invalid on some operating systems",
        "x" * 300: "a name that is invalid on some operating systems",
        "set/A.txt": "the same name on some systems",
        "SET/c.txt": "the same name on some systems",
        "set/a.txt/c": "both as a file and as a folder",
        "set/deep": "twice",
    }


def write(tmp_path, content):
    archive = tmp_path / "bad.archive"
    archive.write_bytes(content)
    return archive, tmp_path / "new"


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_good(kind, tmp_path, archives):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD))
    assert unpack(archive, folder, limits=LIMITS) == 3
    assert {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()} == GOOD


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_choose_takes_part_and_renames(kind, tmp_path, archives):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD))
    chosen = unpack(archive, folder, choose=lambda name: "one" if name.endswith("b.bin") else None, limits=LIMITS)
    assert chosen == 1
    assert [p.name for p in folder.iterdir()] == ["one"]
    with pytest.raises(ArchiveError, match="holds none of the expected files"):
        unpack(archive, tmp_path / "none", choose=lambda name: None, limits=LIMITS)
    with pytest.raises(ArchiveError, match="twice"):
        unpack(archive, tmp_path / "same", choose=lambda name: "one", limits=LIMITS)


@pytest.mark.parametrize("kind", ["zip", "tgz"])
@pytest.mark.parametrize("name", bad_names())
def test_bad_names(kind, name, tmp_path, archives):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD | {name: b"harm"}))
    with pytest.raises(ArchiveError, match=bad_names()[name]):
        unpack(archive, folder, limits=LIMITS)
    outside = [p.name for p in tmp_path.iterdir() if p.name not in ("bad.archive", "new")]
    assert outside == []
    assert kind == "tgz" or not any(folder.iterdir())  # of a zip nothing at all is written


def test_bad_members_are_refused_even_where_not_wanted(tmp_path, archives):
    archive, folder = write(tmp_path, archives.zip(GOOD | {"../outside": b"harm"}))
    with pytest.raises(ArchiveError, match="is outside"):
        unpack(archive, folder, choose=lambda name: name if name == "set/a.txt" else None, limits=LIMITS)


def test_odd_names_do_no_harm_where_not_wanted(tmp_path, archives):
    odd = {"Icon\r": b"", "__MACOSX/._a.txt": b"", "set/A.TXT": b"", "nul": b""}
    archive, folder = write(tmp_path, archives.zip(GOOD | odd))
    assert unpack(archive, folder, choose=lambda name: name if name in GOOD else None, limits=LIMITS) == 3


def test_a_member_twice(tmp_path, archives):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as zipped:
        zipped.writestr("a", b"1")
        with pytest.warns(UserWarning, match="Duplicate name"):
            zipped.writestr("a", b"2")
    archive, folder = write(tmp_path, content.getvalue())
    with pytest.raises(ArchiveError, match="holds 'a' twice"):
        unpack(archive, folder, limits=LIMITS)


@pytest.mark.parametrize("mode", [stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO, stat.S_IFSOCK])
def test_zip_links_and_devices(mode, tmp_path, archives):
    archive, folder = write(tmp_path, archives.zip(GOOD | {"set/link": b"/etc/passwd"}, modes={"set/link": mode}))
    with pytest.raises(ArchiveError, match=r"'set/link', (a link|not a regular file); nothing was unpacked"):
        unpack(archive, folder, limits=LIMITS)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (tarfile.SYMTYPE, "a link to '../../etc/passwd'"),
        (tarfile.LNKTYPE, "a link to '../../etc/passwd'"),
        (tarfile.CHRTYPE, "a device, pipe or sparse file"),
        (tarfile.BLKTYPE, "a device, pipe or sparse file"),
        (tarfile.FIFOTYPE, "a device, pipe or sparse file"),
    ],
)
def test_tar_links_and_devices(kind, said, tmp_path, archives):
    archive, folder = write(tmp_path, archives.tgz({"set/link": b"", **GOOD}, kinds={"set/link": kind}))
    with pytest.raises(ArchiveError, match=said):
        unpack(archive, folder, limits=LIMITS)


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_bomb_by_ratio(kind, tmp_path, archives):
    archive, folder = write(tmp_path, getattr(archives, kind)({"bomb": bytes(5_000_000)}))
    assert archive.stat().st_size < 10_000
    with pytest.raises(ArchiveError, match="too much for its 5 kB; it may be a decompression bomb"):
        unpack(archive, folder, limits=LIMITS)
    assert not (folder / "bomb").exists()


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_bomb_by_size_and_by_number(kind, tmp_path, archives):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD))
    with pytest.raises(ArchiveError, match=r"unpacks to more than 300 bytes at 'set/deep/b\.bin'"):
        unpack(archive, folder, limits=Limits(max_bytes=300))
    with pytest.raises(ArchiveError, match="holds more than 2 members"):
        unpack(archive, tmp_path / "other", limits=Limits(max_bytes=10_000, max_files=2))


def test_zip_that_lies_about_a_size(tmp_path, archives):
    """The directory says 10 bytes; the member holds 5 MB of zeros."""
    content = archives.zip({"bomb": bytes(5_000_000)})
    lying = content.replace((5_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    assert lying != content
    archive, folder = write(tmp_path, lying)
    with pytest.raises(ArchiveError, match=r"is damaged \(Bad CRC-32"):
        unpack(archive, folder, limits=LIMITS)
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 10


def test_tar_header_bomb(tmp_path):
    """A long name of 5 MB, which tarfile would read into memory."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz", format=tarfile.GNU_FORMAT) as tar:
        tar.addfile(tarfile.TarInfo("x" * 5_000_000))
    archive, folder = write(tmp_path, content.getvalue())
    with pytest.raises(ArchiveError, match="holds a header of more than 1048576 bytes"):
        unpack(archive, folder, limits=LIMITS)


def test_gzip_that_goes_on_behind_the_tar(tmp_path, archives):
    archive, folder = write(tmp_path, archives.tgz(GOOD) + gzip.compress(bytes(50_000_000)))
    with pytest.raises(ArchiveError, match="continues after its end"):
        unpack(archive, folder, limits=LIMITS)


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_cut_and_corrupted(kind, tmp_path, archives):
    good = getattr(archives, kind)({"a.bin": bytes(i * i % 251 for i in range(9000))})
    for content in (good[:-60], good[: len(good) // 2], good[:200] + bytes([good[200] ^ 255]) + good[201:]):
        archive, folder = write(tmp_path, content)
        with pytest.raises(ArchiveError, match=r"damaged|none of the expected files"):
            unpack(archive, folder, limits=LIMITS)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("content", [b"", b"not an archive", b"<html></html>" * 100, bz2.compress(b"x" * 999)])
def test_no_archive(content, tmp_path):
    archive, folder = write(tmp_path, content)
    with pytest.raises(ArchiveError):
        unpack(archive, folder, limits=LIMITS)


def test_encrypted(tmp_path, archives):
    content = bytearray(archives.zip({"a": b"x"}))
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + at] |= 1
    archive, folder = write(tmp_path, bytes(content))
    with pytest.raises(ArchiveError, match="is encrypted"):
        unpack(archive, folder, limits=LIMITS)


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_disk_full(kind, tmp_path, archives, monkeypatch):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD))
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage(10**9, 10**9, 1000))
    with pytest.raises(NoSpaceError, match=r"has 1 kB free; unpacking bad\.archive needs"):
        unpack(archive, folder, limits=LIMITS)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_disk_full_on_the_way(kind, tmp_path, archives, monkeypatch):
    archive, folder = write(tmp_path, getattr(archives, kind)(GOOD))
    opened = Path.open

    def full(self, mode="r", *args, **options):
        if mode == "xb":
            raise OSError(28, "No space left on device", str(self))
        return opened(self, mode, *args, **options)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(NoSpaceError, match=r"the disk is full: .*a\.txt could not be written"):
        unpack(archive, folder, limits=LIMITS)
