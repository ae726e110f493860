"""Unpacking archives, also such as mean harm."""

import pytest

from gsfusion_nb.recordings.unpack import ArchiveError, unpack

GOOD = {"set/a.txt": b"a" * 100, "set/deep/b.bin": bytes(range(256)), "set/empty": b""}


@pytest.fixture(params=["zip", "tgz"])
def made(request, tmp_path, archives):
    """``made(files)``: an archive, and a folder to unpack it into."""

    def make(files, **options):
        archive = tmp_path / "some.archive"
        archive.write_bytes(getattr(archives, request.param)(files, **options))
        return archive, tmp_path / "new"

    return make


def test_all_files_or_chosen_ones_come_out(made):
    archive, folder = made(GOOD)
    assert unpack(archive, folder) == 3
    assert {
        str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    } == GOOD
    assert (
        unpack(
            archive,
            folder / "b",
            choose=lambda n: "one" if n.endswith("b.bin") else None,
        )
        == 1
    )
    assert [p.name for p in (folder / "b").iterdir()] == ["one"]


@pytest.mark.parametrize(
    "name", ["../outside", "set/../../outside", "/outside", "..\\outside", "C:outside"]
)
def test_nothing_is_written_outside_of_the_folder(made, name, tmp_path):
    archive, folder = made(GOOD | {name: b"harm"})
    with pytest.raises(ArchiveError, match="outside"):
        unpack(archive, folder)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "some.archive"]


def test_links_are_left_out(made):
    archive, folder = made(GOOD | {"set/link": b"/etc/passwd"}, links=("set/link",))
    assert unpack(archive, folder) == 3
    assert not (folder / "set/link").exists()


def test_archives_that_are_damaged_or_empty_are_refused(made):
    archive, folder = made(GOOD)
    with pytest.raises(ArchiveError, match="none of the expected"):
        unpack(archive, folder / "none", choose=lambda name: None)
    for content in (archive.read_bytes()[: archive.stat().st_size // 2], b"", b"no archive"):
        archive.write_bytes(content)
        with pytest.raises(ArchiveError, match="damaged"):
            unpack(archive, folder / str(len(content)))
