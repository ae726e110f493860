"""A repository with one recipe of a table, and its commits."""

import json
import subprocess

from measuring.history import git

RECIPE = """\
[groups]
code = ["code.py", "room"]
[walls]
about = "Walls"
depends = ["code"]
columns = ["", "PSNR", "ATE, cm"]
rows = [["one", "a"], ["both", "b"]]
cells = ["{@; psnr_db:.1f}", "{@; ate_m*100:.2f}"]
texts = { best = "{b; seed=1; psnr_db:.2f} dB" }
[walls.runs]
a = "gsfusion-nb map wall"
b = ["gsfusion-nb map wall --seed 0", "gsfusion-nb map wall --seed 1"]
"""
VALUES = {
    "a": [{"psnr_db": 20.25, "ate_m": 0.01}],
    "b": [{"psnr_db": 20.0, "ate_m": 0.02, "seed": 0}, {"psnr_db": 22.0, "ate_m": 0.02, "seed": 1}],
}


def commit(folder):
    for line in ("init -q", "add -A", "-c user.name=a -c user.email=a@b.c commit -q -m x"):
        subprocess.run(["git", *line.split()], cwd=folder, check=True)


def with_commit(project, commit):
    """The table of the project, as if it had been measured with this commit."""
    path = project / "docs/measured/walls.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"commit": commit}))


def of_another_branch(project):
    """A commit that is in the repository and not in the history of HEAD."""
    here = git("rev-parse", "HEAD", root=project).strip()
    (project / "other.py").write_text("1\n")
    commit(project)
    there = git("rev-parse", "HEAD", root=project).strip()
    subprocess.run(["git", "reset", "-q", "--hard", here], cwd=project, check=True)
    return there


def change_code(project, text):
    (project / "code.py").write_text(text)
    commit(project)
