"""The package of docs/examples/egg_fusion as pip leaves it: its metadata on Python's path."""

import tomllib
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "docs/examples/egg_fusion"


def write_metadata(site: Path) -> Path:
    """Write the metadata to a new folder. Returns the folder, which goes on Python's path."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    name = project["name"]
    version = project["version"]
    about = site / f"{name.replace('-', '_')}-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    points = [
        f"[{group}]\n" + "".join(f"{entry} = {value}\n" for entry, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (about / "entry_points.txt").write_text("\n".join(points))
    return site
