"""The first start at a service, done here: Binder's build in an empty environment, and Colab's first cells.

    python tests/campaign/fresh_start.py binder colab wheel --python python3.12

``binder``: a fresh clone, an environment with nothing but pip, ``.binder/postBuild``, then the first code cell of every
chapter. ``colab``: an environment that has only Jupyter; a notebook that begins with ``%pip install WHEEL``, followed
by the first code cell of a chapter. ``wheel``: the wheel installed without a compiler, binaries only, in an environment
with nothing but pip; then the commands of its first page. Each takes some minutes and 2 to 6 GB, which are removed. The
variable TORCH_INDEX is passed on.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))


def run(command: list[str | Path], folder: Path, **environment: str) -> str:
    """Run a command in a folder; what it printed. Ends with its last lines where it fails."""
    done = subprocess.run(
        list(map(str, command)), cwd=folder, env={**os.environ, **environment}, text=True, capture_output=True
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))} failed:\n{(done.stdout + done.stderr)[-3000:]}")
    return done.stdout


def environment(folder: Path, python: str) -> Path:
    """A new environment with pip; its folder of programs."""
    run([python, "-m", "venv", folder], folder.parent)
    return folder / "bin"


def wheel(folder: Path) -> Path:
    """The wheel of this tree."""
    shutil.rmtree(ROOT / "build", ignore_errors=True)  # setuptools would put its files into the wheel
    run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT], folder)
    return next(folder.glob("*.whl"))


def first_cell(notebook: Path) -> str:
    """The first code cell of a chapter."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return next("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def execute(cells: list[str], programs: Path, folder: Path) -> None:
    """Run cells as a notebook in a kernel of an environment."""
    code = [
        {"cell_type": "code", "id": f"c{k}", "source": c, "metadata": {}, "outputs": [], "execution_count": None}
        for k, c in enumerate(cells)
    ]
    (folder / "x.ipynb").write_text(json.dumps({"cells": code, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}))
    options = ["--to", "notebook", "--execute", "--ExecutePreprocessor.timeout=1800", "x.ipynb", "--output", "y.ipynb"]
    own = {"JUPYTER_PATH": str(programs.parent / "share/jupyter"), "GSNB_COURSE_FILE": str(folder / "course.json")}
    run([programs / "python", "-m", "nbconvert", *options], folder, PATH=f"{programs}:{os.environ['PATH']}", **own)


def binder(folder: Path, python: str) -> None:
    """A fresh clone, and what Binder runs in it."""
    run(["git", "clone", "--quiet", "--depth", "1", f"file://{ROOT}", folder / "clone"], folder)
    programs = environment(folder / "env", python)
    index = os.environ.get("TORCH_INDEX", "https://pypi.org/simple")
    path = f"{programs}:{os.environ['PATH']}"
    run(["bash", ".binder/postBuild"], folder / "clone", PATH=path, TORCH_INDEX=index)
    for notebook in CHAPTERS:
        execute([first_cell(notebook)], programs, folder / "clone" / "notebooks")


def colab(folder: Path, python: str) -> None:
    """The wheel, installed by the first cell of a notebook in a folder that is no clone."""
    built = wheel(folder)
    programs = environment(folder / "env", python)
    run([programs / "python", "-m", "pip", "install", "--quiet", "nbconvert", "ipykernel"], folder)
    (folder / "content").mkdir()
    cells = [f"%pip install --quiet {built}", *(first_cell(notebook) for notebook in CHAPTERS)]
    execute(cells, programs, folder / "content")


def empty(folder: Path, python: str) -> None:
    """The wheel without a compiler, and the first commands."""
    built = wheel(folder)
    programs = environment(folder / "env", python)
    none = {"CC": "/bin/false", "CXX": "/bin/false"}
    run([programs / "python", "-m", "pip", "install", "--quiet", "--only-binary", ":all:", built], folder, **none)
    said = run([programs / "gsfusion-nb"], folder, **none)
    if "gsfusion-nb course" not in said:
        sys.exit(f"gsfusion-nb without arguments does not name the course:\n{said}")
    run([programs / "gsfusion-nb", "doctor"], folder, **none)
    run([programs / "gsfusion-nb", "course", folder / "course"], folder, **none)
    copied = {notebook.name for notebook in folder.joinpath("course").rglob("*.ipynb")}
    if missing := {notebook.name for notebook in CHAPTERS} - copied:
        sys.exit(f"gsfusion-nb course did not copy {', '.join(sorted(missing))}")
    run([programs / "gsfusion-nb", "demo", "--frames", "12", "--out", folder / "demo"], folder, **none)
    if not (folder / "demo" / "report.html").exists():
        sys.exit("gsfusion-nb demo wrote no report.html")


def cpu_seconds() -> float:
    """Time of processors that the programs started here have used, seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Do what is asked for, one after the other."""
    kinds = {"binder": binder, "colab": colab, "wheel": empty}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=kinds)
    parser.add_argument("--python", default=sys.executable)
    options = parser.parse_args()
    for kind in options.kinds:
        began, cpu = time.monotonic(), cpu_seconds()
        with tempfile.TemporaryDirectory(prefix="gsnb-fresh-") as folder:
            os.environ["GSFUSION_CACHE"] = f"{folder}/cache"
            kinds[kind](Path(folder), options.python)
            size = sum(path.lstat().st_size for path in Path(folder, "env").rglob("*") if not path.is_dir())
        took = f"{time.monotonic() - began:.0f} s, {cpu_seconds() - cpu:.0f} s of processors"
        sys.stdout.write(f"{kind}: done in {took}; the environment has {size / 1e6:.0f} MB\n")


if __name__ == "__main__":
    main()
