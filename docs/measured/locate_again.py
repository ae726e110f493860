"""Another recording located in the map of one:
``python docs/measured/locate_again.py "map DATA OPTIONS" "locate DATA OPTIONS"``.

Both are commands of ``gsfusion-nb``, without the folder of the run.
"""

import contextlib
import json
import shlex
import sys
import tempfile
from pathlib import Path

from gsfusion_nb.cli import main

UNKNOWN = 3
"""Exit status of ``locate`` if no frame was located."""
mapping, locating = (shlex.split(command) for command in sys.argv[1:])
with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
    run, located = Path(folder) / "run", Path(folder) / "located"
    if status := main([*mapping, "--out", str(run)]):
        sys.exit(status)
    status = main([locating[0], str(run), *locating[1:], "--out", str(located)])
    if status not in (0, UNKNOWN):
        sys.exit(status)
    document = json.loads((located / "metrics.json").read_text(encoding="utf-8"))
print(json.dumps(document["metrics"]))  # noqa: T201
