"""What a rule reads besides its context is refused unless an option names it: files, environment, other programs."""

import glob
import os
import sqlite3
import subprocess
import tempfile
import threading
import urllib.request
from pathlib import Path

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
    urllib.request.build_opener(urllib.request.ProxyHandler({})).open("http://127.0.0.1:9", timeout=1)


def written(folder):
    (folder / "new").write_text("3")


READS = {
    "open": (lambda folder: (folder / "text").open().close(), "text"),
    "Path.read_text": (lambda folder: (folder / "text").read_text(), "text"),
    "os.open": (descriptor, "text"),
    "np.load": (lambda folder: np.load(folder / "array.npy"), "array.npy"),
    "np.loadtxt": (lambda folder: np.loadtxt(folder / "text"), "text"),
    "np.fromfile": (lambda folder: np.fromfile(folder / "text", dtype=np.uint8), "text"),
    "np.memmap": (lambda folder: np.memmap(folder / "text", mode="r").sum(), "text"),
    "torch.load": (lambda folder: torch.load(folder / "weights.pt", weights_only=True), "weights.pt"),
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
    "network": (connected, "uses the network"),
    "thread": (started_thread, "starts a thread"),
}


@pytest.mark.parametrize(("read", "what"), READS.values(), ids=READS)
def test_what_no_option_names_is_refused_with_its_name(folder, read, what):
    with pytest.raises(UndeclaredError, match=what), only_declared("mine"):
        read(folder)


def temporary(folder):
    with tempfile.NamedTemporaryFile() as file:
        file.write(b"3")
        file.flush()
        assert Path(file.name).read_bytes() == b"3"


ALLOWED = {
    "declared folder": lambda folder: (folder / "text").read_text(),
    "temporary file of its own": temporary,
    "a module of Python": lambda folder: __import__("colorsys"),
    "the user's folder": lambda folder: Path("~/x").expanduser(),
    "a table in memory": lambda folder: sqlite3.connect(":memory:").close(),
}


@pytest.mark.parametrize("read", ALLOWED.values(), ids=ALLOWED)
def test_what_decides_nothing_or_is_declared_is_allowed(folder, read):
    with only_declared("mine", [folder]):
        read(folder)


def test_the_environment_is_as_before_afterwards():
    read = type(os.environ).__getitem__
    with only_declared("mine"):
        pass
    assert type(os.environ).__getitem__ is read


def test_check_rule_refuses_a_rule_that_reads_what_no_option_names(folder):
    def reads(ctx):
        return ctx.seeds_at(ctx.pixels()[:: int((folder / "text").read_text())], 1.0)

    def declares(ctx, *, file: Path = folder / "text"):
        return ctx.seeds_at(ctx.pixels()[:: int(file.read_text())], 1.0)

    with pytest.raises(AssertionError, match=r"'reads' reads .*text, which none of its options names"):
        check_rule(reads)
    assert check_rule(declares).seeds["new"] > 0


def test_what_a_file_reads_while_it_is_loaded_is_noted(tmp_path):
    from gsfusion_nb.seeding.rule_code import refuse_undeclared

    (tmp_path / "step.txt").write_text("3")
    (tmp_path / "helper.py").write_text(f"STEP = int(open({str(tmp_path / 'step.txt')!r}).read())\n")
    (tmp_path / "rule.py").write_text("import helper\ndef rule(ctx):\n    return helper.STEP\n")
    with pytest.warns(ResourceWarning):
        rule = load_rule_file(f"{tmp_path / 'rule.py'}:rule")
    with pytest.raises(UndeclaredError, match=r"step\.txt"):
        refuse_undeclared(rule, [])
