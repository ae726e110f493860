"""Programs from npm, for tests: where they are.

They are not installed by the tests: install them in any folder and name it in $GSNB_NPM, see ``INSTALL``.
"""

import os
import shutil
from pathlib import Path

import pytest

INSTALL = "npm install --prefix DIR axe-core"


def npm_folder(*packages: str) -> Path:
    """The folder with these packages; the test is skipped, with the reason, where there is none."""
    folder = Path(os.environ.get("GSNB_NPM", ""), "node_modules")
    lacking = [name for name in packages if not (folder / name / "package.json").is_file()]
    if "GSNB_NPM" not in os.environ or lacking or shutil.which("node") is None:
        pytest.skip(f"no {' and '.join(lacking or packages)} from npm here; {INSTALL}, then GSNB_NPM=DIR")
    return folder
