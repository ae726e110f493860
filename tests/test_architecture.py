"""ARCHITECTURE.md is true: its floors are those of the layout test, and an example of everything it
says how to add is added to a copy of the package, in exactly the files it names, and works."""

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import textwrap
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")

RULE = '''
"""A rule for a test."""

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule


@seeding_rule
def toy_rule(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    """Every ``step_px``-th pixel of every ``step_px``-th row."""
    return ctx.seeds_at(ctx.pixels(), 1.0)[:: step_px**2]
'''

READER = '''
"""Frames in one NumPy file."""

from pathlib import Path

import numpy as np
import torch

from ...types import Camera, Frame
from ..recorded.recorded_sequence import Layout


class Frames:
    """A sequence of flat walls."""

    name = "toy"
    camera = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)

    def __init__(self, depth_m):
        self.depth_m = depth_m

    def __len__(self):
        return len(self.depth_m)

    def __getitem__(self, i):
        if i >= len(self):
            raise IndexError(i)
        depth_m = torch.full((48, 64), self.depth_m[i])
        rgb = torch.rand(48, 64, 3)
        return Frame(
            index=i,
            timestamp_s=i / 30,
            rgb=rgb,
            depth_m=depth_m,
            camera=self.camera,
            T_WC=self.pose(i),
        )

    def pose(self, i):
        return torch.eye(4)


def toy_reader(path: Path) -> Frames:
    """Depths of the walls: ``depth_m`` of frames.npz."""
    return Frames([float(d) for d in np.load(path / "frames.npz")["depth_m"]])


LAYOUT = Layout(read=toy_reader, looks_for=("frames.npz",))
'''

OPERATION = '''
"""Twice a number."""

from torch import Tensor

from ..backends import op


@op("toy_operation")
def toy_operation(x: Tensor) -> Tensor:
    """2 x."""
    return 2 * x


@op("toy_operation")
def toy_operation_vjp(v: Tensor) -> Tensor:
    """dL/dx of dL/d(2 x)."""
    return 2 * v
'''

CASES = '''
"""Cases of ``toy_operation``."""

import torch

from gsfusion_nb.optim import toy_operation

from . import Case


def cases():
    """One."""

    def run(device, dtype):
        return {"y": toy_operation(torch.arange(3, device=device, dtype=dtype))}

    yield Case(name="three numbers", operations=("toy_operation",), run=run)
'''

BACKEND = '''
"""Twice a number, by addition."""

CALLS = []


def toy_operation(x):
    """See ``gsfusion_nb.optim.toy_operation``."""
    CALLS.append(x)
    return x + x
'''

SYSTEM_CONFIG = '''
"""Settings of a toy system."""

from dataclasses import dataclass, field

from .parts import SystemConfig, TsdfConfig
from .values import replace


@dataclass(frozen=True, kw_only=True)
class ToyConfig(SystemConfig):
    """All settings."""

    tsdf: TsdfConfig = field(default_factory=lambda: TsdfConfig(voxel_size_m=0.1))
    steps: int = 2
    """Optimisation steps per frame. Larger: better pictures. Usual: 1 to 5."""


def toy_system(preset: str = "replica", **overrides) -> ToyConfig:
    """Settings by preset; there is only one."""
    return replace(ToyConfig(), **overrides)
'''

SYSTEM = '''
"""A toy system: Gaussians where the rule puts them, optimised against every frame.

A TSDF serves only for the mesh.
"""

from torch import Tensor

from ..config import OptimConfig
from ..config.toy_system import ToyConfig, toy_system
from ..optim import adam_step, l1_mse_vjp
from ..render import render_forward, render_vjp
from ..tsdf import integrate
from .description import SystemDescription
from .step_report import StepReport
from .tsdf_mapping import TsdfMapping


class ToySystem(TsdfMapping):
    """The mapper."""

    description = SystemDescription(title="Toy system")
    config_type = ToyConfig
    preset = toy_system

    @property
    def n_passes(self) -> int:
        return 1

    def map_frame(self, frame) -> StepReport:
        seeds = self.propose_seeds(self.seed_context(frame, volume=self.volume, near_m=0.1))
        with self.transaction.changes():
            self.gaussians.append(seeds, frame.index)
            self.keyframes.append(frame)
            with self.clock("optimise"):
                losses = tuple(float(self._optimise(frame)) for _ in range(self.config.steps))
        with self.clock("tsdf"):
            integrate(self.volume, frame)
        return self.reports.of_frame(frame, seeds, True, losses=losses)

    def _global_step(self, i: int) -> Tensor:
        return self._optimise(self.keyframes[i])

    def _optimise(self, view) -> Tensor:
        params = self.gaussians.params
        output, saved = render_forward(params, view.camera, view.T_WC, with_indices=False)
        loss = l1_mse_vjp(output.rgb, view.rgb)
        adam_step(self.gaussians, render_vjp(saved, loss.v_rgb), OptimConfig())
        return loss.value
'''

CHAPTER = '''
"""Exercises of a toy chapter."""

from .exercise import Attempt, Wrong, exercise


@exercise(
    chapter=12,
    difficulty=1,
    minutes=1,
    solution=lambda x: x + x,
    hints=("Add it to itself.",),
    wrong=(Wrong(lambda x: x, says="twice"),),
)
def toy_exercise(attempt: Attempt) -> None:
    """Twice a number."""
    attempt.close(attempt.on("3")(3), 6, "the result is twice the number")
'''

OWN_EXERCISE = '''
"""Exercises for a test, whose function runs in the library."""

from .learner_operation import Becomes
from .exercise import Attempt, Wrong, exercise


@exercise(
    chapter=12,
    difficulty=1,
    minutes=1,
    solution=lambda x: x + x,
    hints=("Add it to itself.",),
    wrong=(Wrong(lambda x: x, says="twice"),),
    becomes=Becomes("toy_piece", lambda yours, x: yours(x)),
)
def toy_own(attempt: Attempt) -> None:
    """Twice a number."""
    attempt.close(attempt.on("3")(3), 6, "the result is twice the number")
'''

PIECE = '''
"""A piece of an operation for a test."""

from ..backends import piece


@piece
def toy_piece(x):
    """Twice a number."""
    return x + x
'''

NOTEBOOK = '{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}\n'
WHOLE = {
    "a seeding rule": {
        "gsfusion_nb/seeding/rules/toy_rule.py": RULE,
        "gsfusion_nb/seeding/rules/__init__.py": (
            "+",
            "from .toy_rule import toy_rule as toy_rule\n",
        ),
    },
    "a data set": {"gsfusion_nb/data/readers/toy_reader.py": READER},
    "an operation": {
        "gsfusion_nb/optim/toy_operation.py": OPERATION,
        "gsfusion_nb/optim/__init__.py": (
            "+",
            "from .toy_operation import toy_operation as toy_operation\n",
        ),
        "tests/plugins/kernel_cases/toy_operation.py": CASES,
    },
    "a backend of an operation": {"kernels/toy_operation/numba.py": BACKEND},
    "a system": {
        "gsfusion_nb/config/toy_system.py": SYSTEM_CONFIG,
        "gsfusion_nb/mapping/toy_system.py": SYSTEM,
        "gsfusion_nb/mapping/systems.py": (
            ("from .rtg_slam import", "from .toy_system import ToySystem\n"),
            ('    "rtg_slam":', '    "toy_system": ToySystem,\n'),
        ),
    },
    "a chapter": {
        "gsfusion_nb/course/toy_chapter.py": CHAPTER,
        "notebooks/12_toy_chapter.ipynb": NOTEBOOK,
        "README.md": (
            ("| `10_backends_and_speed`", "| `12_toy_chapter` | a toy | nothing | 1 min |\n"),
        ),
    },
    "an exercise whose function runs in the library": {
        "gsfusion_nb/course/toy_own.py": OWN_EXERCISE,
        "gsfusion_nb/optim/toy_piece.py": PIECE,
    },
    "a setting": {
        "gsfusion_nb/config/parts.py": (
            (
                "    near_m: float",
                '    toy_m: float = 0.1\n    """A length, metres. Larger: more. Usual: 0 to '
                '1."""\n',
            ),
        ),
        "gsfusion_nb/config/gsfusion.py": (
            (
                "    lr_xyz: float",
                '    toy_steps: int = 3\n    """Steps. Larger: slower. Usual: 1 to 5."""\n',
            ),
        ),
    },
}
"""What is added -> file -> its text; ("+", text) to append; or pairs (beginning of a line, text to
put before it)."""

USE = """
import sys, tempfile
from pathlib import Path
import numpy as np, torch
import gsfusion_nb
assert Path(gsfusion_nb.__file__).is_relative_to(Path.cwd()), gsfusion_nb.__file__
from gsfusion_nb import backends, cli, open_sequence, run_mapping
from gsfusion_nb.config.toy_system import toy_system
from gsfusion_nb.optim import toy_operation
from gsfusion_nb.seeding import check_rule
from gsfusion_nb.course import check

check_rule("toy_rule")

data = Path(tempfile.mkdtemp())
np.savez(data / "frames.npz", depth_m=[1.0, 1.5, 2.0])
walls = open_sequence(data).mapping
assert len(walls) == 3 and float(walls[1].depth_m.mean()) == 1.5

assert toy_operation.reference(torch.ones(2)).tolist() == [2, 2]
assert backends.offered("toy_operation") == ("numba",)
sys.path.append("tests/plugins")
from kernel_cases import all_cases
mine = [case for case in all_cases() if case.operations == ("toy_operation",)]
by_backend = []
for name in ("reference", "numba"):
    with backends.use_backend(name):
        by_backend.append(mine[0].run(torch.device("cpu"), torch.float64)["y"].tolist())
assert by_backend == [[0, 2, 4]] * 2
assert backends.load("toy_operation", "numba").__globals__["CALLS"]

config = toy_system(seeding__rule="toy_rule", data__hold_out_every=0)
run = run_mapping(data, config, folder="toy_run")
state = run.mapper.state_dict()
assert run.mapper.from_state_dict(state).volume.n_blocks == run.mapper.volume.n_blocks > 0
assert run.metrics["psnr_mapped_db"] > 0 and (run.folder / "gaussians.ply").is_file(), run.metrics
assert (run.folder / "report.html").is_file() and (run.folder / "mesh.ply").is_file()

assert check.toy_exercise(lambda x: 2 * x) and not check.toy_exercise(lambda x: x)

from gsfusion_nb.optim.toy_piece import toy_piece
from gsfusion_nb.course import mine as own

calls = []
assert check.toy_own(lambda x: calls.append(x) or 2 * x)
calls.clear()
with backends.use_backend("mine"):
    assert toy_piece(4) == 8 and calls == [4]
assert toy_piece(4) == 8 and calls == [4] and "toy_piece" in own.board().yours

from gsfusion_nb import gsfusion
assert gsfusion("room", tsdf__toy_m=0.3).tsdf.toy_m == 0.3
assert gsfusion("room", optim__toy_steps=4).optim.toy_steps == 4
try:
    cli.main(["map", "--help-all"])
except SystemExit:
    pass
"""


def rows() -> dict[str, list[str]]:
    """What can be added -> the files that the page names for it."""
    section = PAGE.split("## How to add")[1].split("\n## ")[0]
    cells = [
        [c.strip() for c in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("| a")
    ]
    return {name: re.findall(r"`([^`]+)`", files) for name, files, *_ in cells}


def matches(named: str, file: str) -> bool:
    return bool(re.fullmatch(re.sub(r"<\w+>", r"\\w+", named.replace(".", r"\.")), file))


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A copy of the package with all examples added."""
    root = tmp_path_factory.mktemp("copy")
    # compiled sources stay
    without_kernels = shutil.ignore_patterns("*.nbc", "*.nbi", "*.lock", ".ipynb_checkpoints")
    shutil.copytree(ROOT / "gsfusion_nb", root / "gsfusion_nb", ignore=without_kernels)
    shutil.copytree(ROOT / "kernels", root / "gsfusion_nb/kernels", ignore=without_kernels)
    (root / "kernels").symlink_to(root / "gsfusion_nb/kernels")
    shutil.copytree(
        ROOT / "tests/plugins/kernel_cases",
        root / "tests/plugins/kernel_cases",
        ignore=without_kernels,
    )
    (root / "notebooks").mkdir()
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, root)
    for files in WHOLE.values():
        for name, change in files.items():
            add(root / name, change)
    return root


def add(path: Path, change) -> None:
    if isinstance(change, str):
        assert not path.exists(), f"{path} exists already"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(change).lstrip("\n"))
        return
    text = path.read_text()
    if change[0] == "+":
        path.write_text(text + change[1])
        return
    for beginning, line in change:
        assert "\n" + beginning in text, f"{path.name}: {beginning!r} must begin a line"
        text = text.replace("\n" + beginning, "\n" + line + beginning, 1)
    path.write_text(text)


def test_the_floors_are_those_of_the_layout_test():
    spec = importlib.util.spec_from_file_location("layout", ROOT / "tests/test_layout.py")
    assert spec is not None
    assert spec.loader is not None
    layout = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(layout)
    floors = {}
    for floor, names in re.findall(r"^\| +(\d+) \| (`[^|]+`) \|", PAGE, re.MULTILINE):
        floors |= dict.fromkeys(re.findall(r"`(\w+)`", names), int(floor))
    assert floors == {room: floor for room, floor in layout.FLOORS.items() if room != "__main__"}
    drawing = (ROOT / "docs/images/architecture.svg").read_text()
    assert not [room for room in floors if f">{room}</text>" not in drawing], (
        "the drawing lacks rooms"
    )


def test_each_example_is_in_the_files_that_the_page_names():
    named = rows()
    assert set(named) == set(WHOLE)
    for what, files in WHOLE.items():
        unnamed = [f for f in files if not any(matches(n, f) for n in named[what])]
        unused = [n for n in named[what] if not any(matches(n, f) for f in files)]
        assert (unnamed, unused) == ([], []), f"{what}: not named {unnamed}, not needed {unused}"


INDEX = (ROOT / "docs/equations.md").read_text(encoding="utf-8")
EQUATIONS = [
    (paper, *row)
    for paper in ("GSFusion", "RTG-SLAM")
    for row in re.findall(
        r"^\| +(\d+) \| .* \| `([^`]+)` \| `(\w+)` \|$",
        INDEX.split(f"## {paper} ")[1].split("\n## ")[0],
        re.MULTILINE,
    )
]
GRADIENTS = re.findall(
    r"^\| .* \| `([^`]+)` \| `(\w+)` \| (`.+`) \|$", INDEX.split("## Gradients")[1], re.MULTILINE
)
NOT_EVALUATED = ("GSFusion", "1")
"""The density of a Gaussian in space is never computed, so no line has its formula."""
NUMBERS = {"GSFusion": r"(?<!Kerbl )(?<!RTG-SLAM )Eq\. ", "RTG-SLAM": r"RTG-SLAM Eq\. "}


def lines_of(file: str, function: str) -> range:
    """Line numbers of a function or class."""
    nodes = [
        n
        for n in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8")))
        if isinstance(n, ast.FunctionDef | ast.ClassDef) and n.name == function
    ]
    assert len(nodes) == 1, f"{file} has {len(nodes)} {function}"
    return range(nodes[0].lineno, (nodes[0].end_lineno or 0) + 1)


def comments_beside_code(file: str, lines: range) -> list[str]:
    """Comments on lines that also hold code; not docstrings."""
    with tokenize.open(ROOT / file) as f:
        tokens = list(tokenize.generate_tokens(f.readline))
    comments = [t for t in tokens if t.type == tokenize.COMMENT and t.start[0] in lines]
    return [t.string for t in comments if t.line[: t.start[1]].strip()]


@pytest.mark.parametrize(("paper", "number", "file", "function"), EQUATIONS)
def test_each_equation_is_a_comment_at_its_formula(paper, number, file, function):
    lines = lines_of(file, function)
    if (paper, number) == NOT_EVALUATED:
        return
    comments = comments_beside_code(file, lines)
    found = [
        c
        for comment in comments
        for c in re.findall(NUMBERS[paper] + r"(\d+)(?:-(\d+)| and (\d+))?", comment)
    ]
    numbers = {n for a, b, c in found for n in [*range(int(a), int(b or a) + 1), int(c or a)]}
    assert int(number) in numbers, (
        f"no line of {function} in {file} has {paper} Eq. {number}, only {sorted(numbers)}"
    )


def test_the_index_has_every_equation_of_both_papers():
    assert [int(number) for _, number, *_ in EQUATIONS] == [*range(1, 13), *range(1, 11)]


@pytest.mark.parametrize(("file", "function", "pieces"), GRADIENTS)
def test_each_gradient_is_where_the_index_says(file, function, pieces):
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    for piece in re.findall(r"`([^`]+)`", pieces):
        found = [n for n in lines_of(file, function) if piece in lines[n - 1]]
        assert len(found) == 1, f"{function} in {file} has {len(found)} lines with {piece}"


def test_the_examples_work(copy):
    environment = os.environ | {"PYTHONPATH": str(copy), "GSFUSION_BACKEND": "reference"}
    done = subprocess.run(
        [sys.executable, "-c", USE],
        cwd=copy,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "--tsdf.toy-m" in done.stdout
    assert "--optim.toy-steps" in done.stdout
