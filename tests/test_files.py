"""Files and folders that are complete or not there, whatever stops the program."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gsfusion_nb.errors import DiskFullError
from gsfusion_nb.files import atomic, atomic_file, atomic_folder, cache_folder, write_file


def test_replaces_and_creates_folders(tmp_path):
    target = tmp_path / "new" / "deep" / "a.txt"
    for text in ("one", "two"):
        with atomic_file(target) as temporary:
            assert temporary.parent == target.parent
            assert temporary.suffix == ".txt"
            temporary.write_text(text)
        assert target.read_text() == text
    assert [p.name for p in target.parent.iterdir()] == ["a.txt"]


def write_half(target, error):
    with atomic_file(target) as temporary:
        temporary.write_text("half")
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(error):
        write_half(target, error)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_text_is_utf8_and_bytes_are_bytes(tmp_path):
    write_file(tmp_path / "text", "é\n")
    write_file(str(tmp_path / "bytes"), b"\xff\x00")
    assert (tmp_path / "text").read_bytes() == b"\xc3\xa9\n"
    assert (tmp_path / "bytes").read_bytes() == b"\xff\x00"


def fill(path, temporary, error=None):
    with atomic_folder(path, temporary) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "x").write_text("1")
        if error:
            raise error


def test_folder_is_removed_after_a_failure(tmp_path):
    path = tmp_path / "new" / "a"
    temporary = tmp_path / "work" / "a"
    with pytest.raises(ZeroDivisionError):
        fill(path, temporary, ZeroDivisionError)
    assert not list(tmp_path.iterdir())  # nor the folders that were made for it
    path.mkdir(parents=True)
    fill(path, temporary)
    assert (path / "deep" / "x").exists()
    with pytest.raises(FileExistsError, match="already exists"):
        fill(path, temporary)


def test_an_unfinished_folder_of_an_earlier_program_is_removed(tmp_path):
    path = tmp_path / "a"
    temporary = tmp_path / "work"
    temporary.mkdir()
    (temporary / "half").write_text("x")
    fill(path, temporary)
    assert [p.name for p in path.iterdir()] == ["deep"]


def test_content_is_flushed_before_the_rename_and_the_name_after_it(tmp_path, monkeypatch):
    order = []

    def fsync(handle):
        order.append(Path(os.readlink(f"/proc/self/fd/{handle}")).name)

    def replace(old, new):
        order.append("rename")
        rename(old, new)

    rename = os.replace
    if not Path("/proc/self/fd").exists():
        pytest.skip("needs /proc to know which file is flushed")
    monkeypatch.setattr(atomic.os, "fsync", fsync)
    monkeypatch.setattr(atomic.os, "replace", replace)
    write_file(tmp_path / "a.txt", "x")
    assert order[0].startswith(".a.")
    assert order[1:] == ["rename", tmp_path.name]
    order.clear()
    fill(tmp_path / "b", tmp_path / "work", False)
    assert order == ["x", "deep", "work", "rename", tmp_path.name]


# The room alone is loaded: importing the package takes seconds, and loads what has no part in this.
STOP_AT = f"""
import os, signal, sys, types
from pathlib import Path

package = types.ModuleType("gsfusion_nb")
package.__path__ = [{str(Path(atomic.__file__).parents[1])!r}]
sys.modules["gsfusion_nb"] = package
from gsfusion_nb.files import atomic

def kill_before(name):
    setattr(atomic.os, name, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
"""
KILLED_FILE = (
    STOP_AT
    + """
with atomic.atomic_file("{target}") as temporary:
    with temporary.open("w") as file:
        file.write("ne")
        file.flush()
        {while_writing}
        file.write("w")
    {when_written}
"""
)
KILLED_FOLDER = (
    STOP_AT
    + """
with atomic.atomic_folder(Path("{target}"), Path("{target}.partial")) as folder:
    (folder / "one").write_text("new")
    {while_writing}
    (folder / "two").write_text("new")
    {when_written}
"""
)
MOMENTS = {
    "while writing": {"while_writing": "os.kill(os.getpid(), signal.SIGKILL)", "when_written": ""},
    "before the flush": {"while_writing": "", "when_written": 'kill_before("fsync")'},
    "before the rename": {"while_writing": "", "when_written": 'kill_before("replace")'},
}


def run_until_killed(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_program_leaves_the_old_file(tmp_path, moment):
    target = tmp_path / "a.txt"
    target.write_text("old")
    run_until_killed(KILLED_FILE.format(target=target, **MOMENTS[moment]))
    assert target.read_text() == "old"
    write_file(target, "new")
    assert target.read_text() == "new"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_program_leaves_no_folder(tmp_path, moment):
    target = tmp_path / "a"
    run_until_killed(KILLED_FOLDER.format(target=target, **MOMENTS[moment]))
    assert not target.exists()
    fill(target, Path(f"{target}.partial"))
    assert [p.name for p in target.iterdir()] == ["deep"]


def test_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("GSFUSION_CACHE", "~/elsewhere")
    assert cache_folder() == Path.home() / "elsewhere"
    monkeypatch.delenv("GSFUSION_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if sys.platform.startswith("linux"):
        assert cache_folder() == tmp_path / "gsfusion_nb"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_limit_of_the_size_of_files_is_not_called_a_full_disk(tmp_path):
    """As ``ulimit -f`` sets it; in a process of its own, which keeps it."""
    code = f"""
import resource
from gsfusion_nb.errors import DiskFullError
from gsfusion_nb.files import write_file
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
write_file("{tmp_path / "small"}", bytes(40_000))
try:
    write_file("{tmp_path / "large"}", bytes(60_000))
except DiskFullError as e:
    print(e)
"""
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert (
        f"{tmp_path / 'large'} cannot be written: this process may write no file of more than 0.1 "
        "MB" in said
    )
    assert "ulimit -f" in said
    assert "disk is full" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["small"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (getattr(errno, "EDQUOT", errno.ENOSPC), "quota" if hasattr(errno, "EDQUOT") else "full"),
        (errno.EFBIG, "the file system of its folder takes no file that is so large"),
    ],
)
def test_what_leaves_no_room_is_named(tmp_path, code, words, monkeypatch):
    monkeypatch.setattr(atomic, "_largest_file_bytes", lambda: None)
    with pytest.raises(DiskFullError, match=words), atomic_file(tmp_path / "map"):
        raise OSError(code, "no room")
