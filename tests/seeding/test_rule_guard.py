"""What a rule reads besides its context is refused unless an option names it: files, environment,
other programs."""

import _thread
import contextlib
import ctypes
import glob
import inspect
import linecache
import os
import sqlite3
import subprocess
import tempfile
import threading
import traceback
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.seeding import check_rule
from gsfusion_nb.seeding.rule_code import load_rule_file
from gsfusion_nb.seeding.rule_guard import UndeclaredError, only_declared


@pytest.fixture
def folder(tmp_path):
    """A folder with files of several kinds."""
    (tmp_path / "text").write_text("3")
    np.save(tmp_path / "array.npy", np.ones(3))
    torch.save(torch.ones(2), tmp_path / "weights.pt")
    cv2.imwrite(str(tmp_path / "picture.png"), np.zeros((2, 2), np.uint8))
    sqlite3.connect(tmp_path / "table.db").execute("create table t(x)").connection.close()
    return tmp_path


def caught(folder):
    try:
        with open(folder / "text"):
            raise OSError
    except OSError:
        return 3


def descriptor(folder):
    os.close(os.open(folder / "text", os.O_RDONLY))


def database(folder):
    sqlite3.connect(folder / "table.db").close()


def started_thread(folder):
    thread = threading.Thread(target=int)
    thread.start()
    thread.join()


def connected(folder):
    urllib.request.build_opener(urllib.request.ProxyHandler({})).open(
        "http://127.0.0.1:9", timeout=1
    )


def written(folder):
    (folder / "new").write_text("3")


def forked(folder):
    if (process := os.fork()) == 0:
        os._exit(0)
    os.waitpid(process, 0)


def made_again(folder):
    with contextlib.suppress(FileExistsError):
        os.mkdir(folder)
    (folder / "text").read_text()


def expanded(folder):
    assert os.path.expandvars("$PATH") != "$PATH"


READS = {
    "open": (lambda folder: (folder / "text").open().close(), "text"),
    "Path.read_text": (lambda folder: (folder / "text").read_text(), "text"),
    "os.open": (descriptor, "text"),
    "np.load": (lambda folder: np.load(folder / "array.npy"), "array.npy"),
    "np.loadtxt": (lambda folder: np.loadtxt(folder / "text"), "text"),
    "np.fromfile": (lambda folder: np.fromfile(folder / "text", dtype=np.uint8), "text"),
    "np.memmap": (lambda folder: np.memmap(folder / "text", mode="r").sum(), "text"),
    "torch.load": (
        lambda folder: torch.load(folder / "weights.pt", weights_only=True),
        "weights.pt",
    ),
    "a folder that was there": (made_again, "text"),
    "sqlite3": (database, "table.db"),
    "an error that it catches": (caught, "text"),
    "os.listdir": (os.listdir, "lists"),
    "glob": (lambda folder: glob.glob(str(folder / "*")), "lists"),
    "Path.iterdir": (lambda folder: list(folder.iterdir()), "lists"),
    "writing": (written, "writes"),
    "subprocess": (lambda folder: subprocess.run(["true"], check=False), "starts a program"),
    "os.system": (lambda folder: os.system("true"), "starts a program"),
    "os.popen": (lambda folder: os.popen("true").close(), "starts a program"),
    "os.environ": (lambda folder: os.environ["PATH"], "environment variable PATH"),
    "os.getenv": (lambda folder: os.getenv("NOT_THERE"), "environment variable NOT_THERE"),
    "in os.environ": (lambda folder: "PATH" in os.environ, "environment variable PATH"),
    "all of os.environ": (lambda folder: dict(os.environ), "environment variable"),
    "names in os.environ": (lambda folder: list(os.environ), "which environment variables"),
    "number in os.environ": (lambda folder: len(os.environ), "which environment variables"),
    "the process in /proc": (
        lambda folder: Path("/proc/self/environ").read_bytes(),
        "reads /proc/self/environ",
    ),
    "a file in /etc": (lambda folder: Path("/etc/hostname").read_text(), "reads /etc/hostname"),
    "random bytes": (lambda folder: open("/dev/urandom", "rb").close(), "/dev/urandom"),
    "NumPy in /etc": (
        lambda folder: np.fromfile("/etc/hostname", dtype=np.uint8),
        "reads /etc/hostname",
    ),
    "torch in /etc": (lambda folder: torch.load("/etc/hostname"), "reads /etc/hostname"),
    "whether there is a file in /etc": (
        lambda folder: os.path.exists("/etc/hostname"),
        "asks for /etc/hostname",
    ),
    "files in /etc": (lambda folder: os.listdir("/etc"), "lists /etc"),
    "linecache": (lambda folder: linecache.getline(str(folder / "text"), 1), "reads .*text"),
    "variable in a text": (expanded, "environment variable PATH"),
    "variable as bytes": (lambda folder: os.environb[b"PATH"], "environment variable PATH"),
    "whether a file exists": (lambda folder: (folder / "text").exists(), "asks for .*text"),
    "whether a file is missing": (lambda folder: os.path.exists(folder / "no"), "asks for .*no "),
    "whether it is a file": (lambda folder: os.path.isfile(folder / "text"), "asks for .*text"),
    "whether it may be read": (
        lambda folder: os.access(folder / "text", os.R_OK),
        "asks for .*text",
    ),
    "date of a file": (lambda folder: os.path.getmtime(folder / "text"), "asks for .*text"),
    "size of a file": (lambda folder: (folder / "text").stat().st_size, "asks for .*text"),
    "link": (lambda folder: (folder / "text").is_symlink(), "asks for .*text"),
    "OpenCV": (lambda folder: cv2.imread(str(folder / "picture.png")), r"picture\.png"),
    "OpenCV's files": (
        lambda folder: cv2.FileStorage(str(folder / "text"), 0).release(),
        "reads .*text",
    ),
    "torch.from_file": (
        lambda folder: torch.from_file(
            str(folder / "text"),
            size=1,
            dtype=torch.uint8,
        ),
        "text",
    ),
    "torch.jit.load": (lambda folder: torch.jit.load(str(folder / "text")), "reads .*text"),
    "a library of C": (lambda folder: ctypes.CDLL(str(folder / "text")), "reads .*text"),
    "removing": (lambda folder: (folder / "text").unlink(), "changes .*text"),
    "renaming": (lambda folder: (folder / "text").rename(folder / "other"), "changes .*text"),
    "another process": (forked, "starts a program"),
    "thread without threading": (
        lambda folder: _thread.start_new_thread(int, ()),
        "starts a thread",
    ),
    "pool of threads": (
        lambda folder: list(ThreadPoolExecutor(1).map(int, "3")),
        "starts a thread",
    ),
    "network": (connected, "uses the network"),
    "thread": (started_thread, "starts a thread"),
}


ITS_OWN = (OSError, RuntimeError, Warning, cv2.error)
"""Errors of what reads, for which these files are none."""


@pytest.mark.parametrize(("read", "what"), READS.values(), ids=READS)
def test_what_no_option_names_is_refused_with_its_name(folder, read, what):
    with (
        pytest.raises(UndeclaredError, match=what),
        only_declared("mine"),
        contextlib.suppress(*ITS_OWN),
    ):
        read(folder)


def temporary(folder):
    with tempfile.NamedTemporaryFile() as file:
        file.write(b"3")
        file.flush()
        assert Path(file.name).read_bytes() == b"3"


def folder_of_its_own(folder):
    with tempfile.TemporaryDirectory() as own:
        file = Path(own) / "x"
        file.write_text("3")
        assert file.exists()
        assert os.listdir(own) == ["x"]


def traced_back(folder):
    try:
        raise OSError
    except OSError:
        traceback.format_exc()


ALLOWED = {
    "temporary folder of its own": folder_of_its_own,
    "the full name of a file": lambda folder: Path(__file__).resolve(),
    "a source line": traced_back,
    "a library of the system": lambda folder: ctypes.CDLL(None),
    "declared picture": lambda folder: cv2.imread(str(folder / "picture.png")),
    "declared file that exists": lambda folder: (folder / "text").exists(),
    "declared folder": lambda folder: (folder / "text").read_text(),
    "temporary file of its own": temporary,
    "a module of Python": lambda folder: __import__("colorsys"),
    "the source of a function": lambda folder: inspect.getsource(traced_back),
    "nothing": lambda folder: Path(os.devnull).read_bytes(),
    "the user's folder": lambda folder: Path("~/x").expanduser(),
    "a table in memory": lambda folder: sqlite3.connect(":memory:").close(),
}


@pytest.mark.parametrize("read", ALLOWED.values(), ids=ALLOWED)
def test_what_decides_nothing_or_is_declared_is_allowed(folder, read):
    with only_declared("mine", [folder]):
        read(folder)


def test_the_environment_is_as_before_afterwards():
    names = [
        (type(os.environ), "__getitem__"),
        (os, "stat"),
        (cv2, "imread"),
        (threading.Thread, "start"),
    ]
    before = [getattr(owner, name) for owner, name in names]
    with only_declared("mine"):
        assert os.stat is not before[1]
    assert [getattr(owner, name) for owner, name in names] == before


def test_check_rule_refuses_a_rule_that_reads_what_no_option_names(folder):
    def reads(ctx):
        return ctx.seeds_at(
            ctx.pixels()[:: int((folder / "text").read_text())],
            1.0,
        )

    def declares(ctx, *, file: Path = folder / "text"):
        return ctx.seeds_at(ctx.pixels()[:: int(file.read_text())], 1.0)

    with pytest.raises(
        AssertionError, match=r"'reads' reads .*text, which none of its options names"
    ):
        check_rule(reads)
    assert check_rule(declares).seeds["new"] > 0


def test_what_a_file_reads_while_it_is_loaded_is_noted(tmp_path):
    from gsfusion_nb.seeding.code_files import refuse_undeclared

    (tmp_path / "step.txt").write_text("3")
    (tmp_path / "helper.py").write_text(
        f"STEP = int(open({str(tmp_path / 'step.txt')!r}).read())\n"
    )
    (tmp_path / "rule.py").write_text("import helper\ndef rule(ctx):\n    return helper.STEP\n")
    with pytest.warns(ResourceWarning):
        rule = load_rule_file(f"{tmp_path / 'rule.py'}:rule")
    with pytest.raises(UndeclaredError, match=r"step\.txt"):
        refuse_undeclared(rule, [])
