"""Each entrant is checked in a fresh process before it counts, once; nothing that it does reaches
other rules."""

import dataclasses
import email.utils
import json
import logging
import os
import platform
import subprocess
import tempfile
import time
import uuid
from pathlib import Path

import pytest
import torch
from box_room import Box

from gsfusion_nb.compare import Entrant, admission, run_all
from gsfusion_nb.compare.admission import Admission
from gsfusion_nb.compare.benchmark import BenchmarkOptions, benchmark_specs
from gsfusion_nb.compare.data_sets import DATA_SETS
from gsfusion_nb.compare.executors import Task, do_sent_task
from gsfusion_nb.compare.fresh_check import _clock_is_watched, confine
from gsfusion_nb.compare.map_scene import Entry, _PrivateFrames
from gsfusion_nb.compare.one_run import run_entry
from gsfusion_nb.compare.recording_specs import RecordingOptions
from gsfusion_nb.compare.run_all import ResultStore
from gsfusion_nb.compare.studies import study_specs
from gsfusion_nb.compare.sweep import SweepOptions, sweep_specs
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import SYSTEMS, GSFusion

RULES = """
import datetime
import os
import random
import threading
import time
from pathlib import Path

import numpy as np
import torch
from box_room import Box
from cv2 import imread

import beside

COUNT = {"n": 0}
LOCK = threading.Lock()


class Kept:
    n = 0


def every(ctx, step):
    return ctx.seeds_at(ctx.pixels()[::step], 1.0)


def plain(ctx):
    return every(ctx, beside.STEP)


def weighed(ctx, *, weights: Path = Path("{weights}")):
    return every(ctx, beside.STEP + int(weights.read_text()))


def unhashable(ctx):
    with LOCK:
        return every(ctx, 9)


def clock(ctx):
    return every(ctx, 9 if time.time() > 0 else 7)


def today(ctx):
    return every(ctx, 9 if datetime.datetime.now().year > 2000 else 7)


def torch_rand(ctx):
    return every(ctx, 8 + int(torch.rand(1) > 0.5))


def numpy_rand(ctx):
    return every(ctx, 8 + int(np.random.rand() > 0.5))


def python_rand(ctx):
    return every(ctx, 8 + int(random.random() > 0.5))


def counter(ctx):
    COUNT["n"] += 1
    return every(ctx, 9 if COUNT["n"] < 10**6 else 7)


def class_counter(ctx):
    Kept.n += 1
    return every(ctx, 9 if Kept.n < 10**6 else 7)


def library_counter(ctx):
    type(ctx).n = getattr(type(ctx), "n", 0) + 1
    return every(ctx, 9)


def patch(ctx):
    type(ctx).normals = type(ctx).has_depth
    return every(ctx, 9)


def switch(ctx):
    torch.set_float32_matmul_precision("high")
    return every(ctx, 9)


def writes(ctx):
    depth_m = ctx.frame.depth_m
    depth_m[depth_m > 1] = 0
    return every(ctx, 9)


def writes_late(ctx):
    if ctx.frame.index > 3:
        ctx.frame.depth_m.numpy()[:] = 0
    return every(ctx, 9)


def environment(ctx):
    return every(ctx, int(os.environ.get("STEP", "9")))


def process(ctx):
    return every(ctx, 9 if os.getpid() else 7)


WORDS = {"a", "b", "c", "d", "e", "f"}


def order(ctx):
    return every(ctx, 5 + sorted(WORDS).index(next(iter(WORDS))))


def count(ctx):
    return every(ctx, 3 + len(WORDS))


def picture(ctx):
    return every(ctx, int(imread("{picture}").mean()))
"""


@pytest.fixture
def file(tmp_path):
    """``FILE.py`` of the rules, with a module beside it."""
    (tmp_path / "beside.py").write_text("STEP = 9\n")
    places = {"{picture}": "nine.png", "{weights}": "weights"}
    text = RULES
    for name, path in places.items():
        text = text.replace(name, str(tmp_path / path))
    (tmp_path / "rules.py").write_text(text)
    return tmp_path / "rules.py"


@pytest.fixture
def entry(spec, file):
    """``entry(name)``: a run of one of the rules on the small scene."""
    plain = spec()
    fields = {name: getattr(plain, name) for name in ("scene", "data", "settings")}
    return lambda name, **more: Entrant(f"{file}:{name}").entry(**fields, **more)


def only(runs):
    ((_, result),) = runs
    return result


def test_a_rule_is_checked_once_in_a_process_of_its_own(fresh_checks, entry, tmp_path, monkeypatch):
    folder = tmp_path / "checks"
    assert admission.admission(entry("plain"), folder) == Admission()
    assert admission.admission(Entry(spec=entry("plain").spec), folder) == Admission()
    monkeypatch.setattr(admission, "_run", lambda *_: pytest.fail("it was checked before"))
    assert admission.admission(entry("plain"), folder) == Admission()


def test_what_the_check_refuses_is_a_row_that_failed(fresh_checks, entry, tmp_path, monkeypatch):
    monkeypatch.setattr(
        admission, "_run", lambda *_: {"refused": "it asks for the time", "code": {}}
    )
    result = only(run_all.run_all([entry("clock")], ResultStore(tmp_path / "cache")))
    assert (result.status, result.reason) == ("failed", "it asks for the time")


def test_a_check_that_cannot_be_made_is_a_row_that_failed(
    fresh_checks, entry, tmp_path, monkeypatch
):
    def broken(*_):
        raise TypeError("no answer")

    monkeypatch.setattr(admission, "_run", broken)
    result = only(run_all.run_all([entry("clock")], ResultStore(tmp_path / "cache")))
    assert (result.status, result.reason) == ("failed", "TypeError: no answer")


def test_a_check_that_ends_early_says_its_last_words(fresh_checks, entry, tmp_path, monkeypatch):
    def ended(*_, **__):
        return subprocess.CompletedProcess([], 1, "", "Traceback\n  a line\nMemoryError: 3 GB\n")

    monkeypatch.setattr(subprocess, "run", ended)
    found = admission.admission(entry("plain"), tmp_path / "checks")
    assert found.refused.endswith("ended early: MemoryError: 3 GB")


REFUSED = {
    "clock": r"asks for the time \(time\.time\)",
    "today": "asks for the time",
    "torch_rand": "global generator",
    "numpy_rand": "gave other seeds|different seeds",
    "python_rand": "gave other seeds|different seeds",
    "counter": "keeps something from one frame to the next",
    "class_counter": "keeps something from one frame to the next",
    "library_counter": r"changes gsfusion_nb\.seeding\.context\.SeedContext\.n for everybody",
    "patch": r"changes gsfusion_nb\.seeding\.context\.SeedContext\.normals for everybody",
    "switch": "changes a setting of the whole process: matmul precision",
    "process": r"asks for what differs from process to process \(posix\.getpid\)",
    "order": "gives other seeds in another process: the order of the texts in a set",
    "writes": r"changed frame\.depth_m in place",
    "environment": "reads the environment variable STEP",
}


@pytest.mark.ci
@pytest.mark.parametrize(("name", "reason"), REFUSED.items(), ids=REFUSED)
def test_the_check_refuses(fresh_checks, entry, tmp_path, name, reason):
    import re

    assert re.search(reason, admission.admission(entry(name), tmp_path / "checks").refused)


@pytest.mark.ci
def test_a_set_whose_order_does_not_matter_is_fine(fresh_checks, entry, tmp_path):
    assert admission.admission(entry("count"), tmp_path / "checks") == Admission()


def test_a_rule_with_sets_is_checked_in_other_orders(fresh_checks, entry, tmp_path, monkeypatch):
    orders = []

    def run(entry, rule, order="1"):
        orders.append(order)
        return {
            "refused": "",
            "code": entry.spec.code,
            "walks_sets": name == "count",
            "seeds": seeds[order],
        }

    monkeypatch.setattr(admission, "_run", run)
    for name, seeds, most in (
        ("plain", {"1": "x"}, 1),
        ("count", dict.fromkeys("1234", "x"), 4),
        ("count", {"1": "x", "2": "x", "3": "x", "4": "y"}, 4),
    ):
        orders.clear()
        found = admission.admission(entry(name), tmp_path / f"checks {len(set(seeds.values()))}")
        assert (len(orders), len(set(orders))) == (most, most)
        assert ("gives other seeds in another process" in found.refused) == (
            len(set(seeds.values())) > 1
        )


@pytest.mark.parametrize(
    "text", ["{}", '{"refused": 3, "not_kept": ""}', '{"refused": ""}', "[", '{"x": 1}']
)
def test_a_damaged_finding_is_made_again(fresh_checks, entry, tmp_path, monkeypatch, text):
    monkeypatch.setattr(admission, "_run", lambda *_: {"refused": "no", "code": {}})
    assert admission.admission(entry("plain"), tmp_path).refused == "no"
    (file,) = tmp_path.glob("*.json")
    file.write_text(text)
    assert admission.admission(entry("plain"), tmp_path).refused == "no"
    assert json.loads(file.read_text())["refused"] == "no"


@pytest.mark.ci
def test_what_compiled_code_reads_is_refused_where_the_system_can(fresh_checks, entry, tmp_path):
    import subprocess
    import sys

    import cv2
    import numpy as np

    cv2.imwrite(
        str(tmp_path / "nine.png"),
        np.full((4, 4), 9, np.uint8),
    )
    can = (
        "import sys; from gsfusion_nb.compare.fresh_check import confine; sys.exit(not "
        "confine([sys.prefix, '/usr']))"
    )
    if subprocess.run([sys.executable, "-c", can], check=False).returncode:
        pytest.skip("this system has no Landlock")
    assert (
        "which can read only the files"
        in admission.admission(entry("picture"), tmp_path / "checks").refused
    )


ASKS = {
    "time.perf_counter": ("the time", time.perf_counter),
    "time.strftime": ("the time", lambda: time.strftime("%Y")),
    "time.gmtime": ("the time", lambda: time.gmtime().tm_year),
    "posix.cpu_count": ("what differs", lambda: os.cpu_count()),
    "posix.statvfs": ("what differs", lambda: os.statvfs("/").f_bfree),
    "torch._C.get_num_threads": ("what differs", lambda: torch.get_num_threads()),
    "platform.node": ("what differs", lambda: platform.node()),
    "uuid.getnode": ("what differs", lambda: uuid.getnode()),
    "email.utils.formatdate": ("what differs", lambda: email.utils.formatdate()),
    "pathlib.*.cwd": ("what differs", lambda: Path.cwd().name),
}
"""What is named in the message -> of what kind it is, and who asks."""


@pytest.mark.parametrize(("name", "asking"), ASKS.items(), ids=ASKS)
def test_what_only_this_process_knows_is_noticed(name, asking):
    kind, ask = asking
    with (
        pytest.raises(ValueError, match=rf"asks for {kind}.* \({name}\)"),
        _clock_is_watched("mine"),
    ):
        ask()


ASKS_NOTHING = {
    "a library": lambda: torch.ones(3).sum(),
    "a time that is given": lambda: time.strftime("%Y", time.gmtime(3)),
    "waiting": lambda: time.sleep(0),
    "a message to a log": lambda: logging.getLogger("mine").debug("a"),
    "the full name of a file": lambda: Path("a").resolve(),
    "a temporary file": lambda: tempfile.TemporaryFile().close(),
}


@pytest.mark.parametrize("work", ASKS_NOTHING.values(), ids=ASKS_NOTHING)
def test_what_decides_nothing_is_not_noticed(work):
    with _clock_is_watched("mine"):
        work()


def test_without_landlock_nothing_is_confined(monkeypatch):
    monkeypatch.setattr("sys.platform", "darwin")
    assert not confine([])


def test_a_rule_that_cannot_be_hashed_is_run_each_time_and_says_so(entry, tmp_path):
    store = ResultStore(tmp_path / "cache")
    results = [only(run_all.run_all([entry("unhashable")], store)) for _ in range(2)]
    assert [result.status for result in results] == ["done", "done"]
    assert results[0].map_hash == results[1].map_hash
    assert results[0].key != results[1].key
    assert [result.copied_from for result in results] == ["", ""]
    assert "global LOCK is a lock, which cannot be hashed" in results[0].notes[0]
    assert not list((tmp_path / "cache" / "results").iterdir())


def test_a_rule_whose_key_is_another_in_every_process_is_not_kept(entry, tmp_path, monkeypatch):
    other = {"refused": "", "code": {"values": "of another process"}}
    monkeypatch.setattr(admission, "_run", lambda *_: other)
    monkeypatch.setattr(run_all, "admission", admission.admission)
    store = ResultStore(tmp_path / "cache")
    results = [only(run_all.run_all([entry("plain")], store)) for _ in range(2)]
    assert "is not the same in every process" in results[1].notes[0]
    assert results[0].key != results[1].key


def test_a_rule_that_writes_into_a_frame_fails_and_spoils_no_other(entry, spec, tmp_path):
    """Also late, in the middle of a run, and past torch."""
    clean = run_entry(Entry(spec=spec("uniform", seed=5))).map_hash
    for name in ("writes", "writes_late"):
        result = run_entry(entry(name))
        assert (result.status, "changed frame.depth_m in place" in result.reason) == (
            "failed",
            True,
        )
    assert run_entry(Entry(spec=spec("uniform", seed=5))).map_hash == clean


def test_the_images_of_a_run_are_its_own(scene):
    kept = open_sequence(scene).mapping[0]
    more = torch.zeros_like(kept.depth_m)
    sequence = open_sequence(scene, extra=lambda frame: {"more": more})
    frame = _PrivateFrames(**vars(sequence.mapping))[0]
    for image in (frame.colour, frame.depth_m, frame.T_WC, frame.extra["more"]):
        image.fill_(1)
    again = sequence.mapping[0]
    assert not more.any()
    assert torch.equal(again.depth_m, kept.depth_m)
    assert torch.equal(again.T_WC, kept.T_WC)
    assert torch.equal(again.colour, kept.colour)


@pytest.mark.ci
def test_a_process_that_loaded_an_older_module_refuses(entry, file):
    """A Dask worker: the files are those of the comparison, but what it has loaded is not."""
    import sys

    made = entry("plain")
    task = Task(kind="run", spec=made.spec, backend="auto")

    def done():
        result = do_sent_task(task).result
        assert result is not None
        return result

    assert done().status == "done"
    module = sys.modules[made.found_rule().__module__]
    module.__dict__["beside"].STEP = 7
    result = done()
    assert (result.status, "code or values as loaded" in result.reason) == ("failed", True)
    module.__dict__["beside"].STEP = 9
    (file.parent / "beside.py").write_text("STEP = 8\n")
    result = done()
    assert (result.status, "file beside" in result.reason) == ("failed", True)


def of_a_sweep(rule, folder):
    return sweep_specs(
        SweepOptions(data=str(folder / "room0"), grid=(f"seeding.rule={rule}",), preset="replica")
    )


def of_a_study(rule, folder):
    options = RecordingOptions(set=(f"seeding.rule={rule}",))
    return study_specs("table-v", options, str(folder / "room0"), only="0.1")


def of_a_benchmark(rule, folder):
    options = BenchmarkOptions(
        name="replica",
        folder=str(folder / "room0"),
        systems=("gsfusion",),
        set=(f"seeding.rule={rule}",),
    )
    return benchmark_specs(DATA_SETS["replica"], options)[0]


@pytest.mark.parametrize("specs_of", [of_a_sweep, of_a_study, of_a_benchmark])
@pytest.mark.parametrize("changed", ["beside.py", "weights"])
def test_a_changed_helper_and_changed_weights_are_seen(file, tmp_path, specs_of, changed):
    Box().replica(tmp_path / "data" / "room0")
    (file.parent / "weights").write_text("9")
    keys = []
    for step in (9, 9, 7):
        text = f"STEP = {step}\n" if changed == "beside.py" else str(step)
        (file.parent / changed).write_text(text)
        spec, *_ = specs_of(f"{file}:weighed", tmp_path / "data")
        keys.append(spec.key)
    assert keys[0] == keys[1] != keys[2]


def test_a_system_of_ones_own_is_part_of_the_key(spec, monkeypatch):
    keys = []
    for share in (1, 1, 2):

        class Mine(GSFusion):
            SHARE = share

        monkeypatch.setitem(SYSTEMS, "mine", Mine)
        one = spec(system="mine")
        keys.append(one.with_code(one.found_rule()).key)
    assert keys[0] == keys[1] != keys[2]
    assert spec(system="gsfusion").key not in keys


def test_where_the_file_lies_is_no_part_of_the_key(entry):
    made = entry("plain").spec
    moved = dataclasses.replace(made, rule_folder="/elsewhere")
    assert moved.key == made.key
    assert json.loads(json.dumps(made.to_json())) == made.to_json()
