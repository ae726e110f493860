"""The script that prepares ScanNet++ scenes from a licensed copy."""

import pytest

from gsfusion_nb.data import open_sequence
from gsfusion_nb.export import write_mesh_ply


@pytest.fixture
def scene(tmp_path, box, copied_scene):
    """A scene as it is handed out, with the scan's mesh."""
    folder = copied_scene.write_copy(tmp_path / "copy/8b5caf3398", box)
    write_mesh_ply(folder / "scans/mesh_aligned_0.05.ply", copied_scene.box_mesh())
    return folder


def test_end_to_end(script, scene, tmp_path, box, copied_scene, capsys):
    out = tmp_path / "data"
    assert script("scannetpp").main([str(scene), "--out", str(out), "--yes"]) == 0
    text = capsys.readouterr().out
    folder = out / "scannetpp/8b5caf3398"
    for part in ("3 photographs", "NON-COMMERCIAL", f"gsfusion-nb map {folder} --preset scannetpp"):
        assert part in text
    opened = open_sequence(folder)
    assert (len(opened.mapping), len(opened.held_out)) == (2, 1)
    copied_scene.check(opened.source, box)
    assert script("scannetpp").main([str(scene), "--out", str(out)]) == 0  # there already: no question
    assert not (out / ".fetch/unfinished/8b5caf3398").exists()
