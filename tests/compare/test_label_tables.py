"""Comparisons whose scenes bring labels."""

import pickle
import shutil

import cv2
import numpy as np
import pytest

from gsfusion_nb.compare import RunSpec
from gsfusion_nb.compare.admission import _extra
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.one_run import run_entry
from gsfusion_nb.compare.table_file import read_table
from gsfusion_nb.data import open_sequence
from gsfusion_nb.seeding import check_rule

RULE = """
from gsfusion_nb.seeding import SeedContext, Seeds


def of_class(ctx: SeedContext, *, wanted: int = 1) -> Seeds:
    return ctx.seeds_at(ctx.pixels(ctx.frame.extra["class"] == wanted)[::5], 2.0)
"""

TABLE = """
seeds = 1
[settings]
"data.hold_out_every" = 4
"data.hold_out_offset" = 2
"tsdf.voxel_size_m" = 0.08
sh_degree = 0
"optim.global_iterations" = 1
[[scenes]]
data = "{scene}"
extra = {{ class = "labels/{{index:03d}}.png" }}
[[rules]]
rule = "of_class.py:of_class"
[[rules]]
rule = "of_class.py:of_class"
label = "nothing"
options = {{ wanted = 7 }}
"""


@pytest.fixture
def table(scene, tmp_path):
    """A table of a rule that reads labels, which a recording has in its left half."""
    scene = shutil.copytree(scene, tmp_path / "wall")
    sequence = open_sequence(scene)
    image = np.zeros((sequence.camera.height, sequence.camera.width), dtype=np.uint8)
    image[:, : image.shape[1] // 2] = 1
    (scene / "labels").mkdir(exist_ok=True)
    for i in range(len(sequence)):
        cv2.imwrite(str(scene / f"labels/{i:03d}.png"), image)
    rule = tmp_path / "of_class.py"
    rule.write_text(RULE)
    file = tmp_path / "table.toml"
    file.write_text(TABLE.format(scene=scene))
    return read_table(file, rule_files=[rule])


def test_labels_from_a_table_reach_a_rule_in_another_process(table):
    """A run of another process is made from the plain values of its spec."""
    of_class, nothing = (
        run_entry(Entry(spec=RunSpec.from_json(spec.to_json()))) for spec in table.specs
    )
    assert of_class.status == "done", of_class.reason
    assert of_class.metrics["n_gaussians"] > 20
    assert not nothing.metrics["n_gaussians"]


def test_the_check_of_a_rule_has_labels_too(table):
    entry = Entry(spec=table.specs[0])
    extra = pickle.loads(_extra(entry))
    check_rule(entry.found_rule(), extra=extra)
