"""How often files of a recording are decoded: each once for a frame, and only those that it
needs."""

import dataclasses
from collections import Counter

import pytest
from published_layouts import seven_scenes_layout, tum_layout

from gsfusion_nb import run_mapping
from gsfusion_nb.config import RepairConfig, gsfusion
from gsfusion_nb.data import folder, repaired, seven_scenes, tum
from gsfusion_nb.data.recorded import recorded_sequence
from gsfusion_nb.data.recorded.decoded_images import DecodedImages
from gsfusion_nb.recordings.checkup import check_recording


@pytest.fixture
def decoded(monkeypatch):
    """How often each file was decoded as an image of a frame."""
    counts = Counter()

    def counting(read):
        def counted(path, **options):
            counts[path.parent.name, path.name] += 1
            return read(path, **options)

        return counted

    for name in ("read_rgb", "read_depth"):
        monkeypatch.setattr(recorded_sequence, name, counting(getattr(recorded_sequence, name)))
    return counts


def kinds(counts: Counter) -> Counter:
    """How often files were decoded, by the folder that they are in."""
    of_folder = Counter()
    for (name, _), n in counts.items():
        of_folder[name] += n
    return of_folder


def test_one_image_alone_decodes_one_file(tmp_path, box, decoded):
    sequence = folder(box.folder(tmp_path, n=3))
    sequence.depth_image(1)
    assert decoded == {("depth", "000001.png"): 1}
    sequence.colour_image(2)
    assert decoded == {("depth", "000001.png"): 1, ("rgb", "000002.jpg"): 1}
    sequence.pose(0)
    assert sum(decoded.values()) == 2


def test_one_rectified_image_decodes_one_file(tmp_path, box, decoded):
    sequence = seven_scenes(seven_scenes_layout(tmp_path / "seq-01", box, n=2), register=True)
    assert sequence.rectification is not None
    sequence.depth_image(1)
    assert [name for _, name in decoded] == ["frame-000001.depth.png"]
    sequence.colour_image(1)
    assert [name for _, name in decoded] == ["frame-000001.depth.png", "frame-000001.color.png"]


@pytest.mark.parametrize("shift", [1, -1])
def test_colour_of_another_frame_decodes_no_image_that_is_not_used(tmp_path, box, decoded, shift):
    mended = repaired(folder(box.folder(tmp_path, n=4)), RepairConfig(rgb_shift_frames=shift))
    mended[2]
    assert decoded == {("depth", "000002.png"): 1, ("rgb", f"00000{2 + shift}.jpg"): 1}


def test_depth_of_another_time_decodes_no_image_that_is_not_used(tmp_path, box, decoded):
    sequence = tum(tum_layout(tmp_path, box, n=6), camera=box.camera)
    mended = repaired(sequence, RepairConfig(depth_offset_s=1 / 30))
    mended[3]
    depth_name = sequence.depth_files[2].name
    rgb_name = sequence.rgb_files[3].name
    assert decoded == {("depth", depth_name): 1, ("rgb", rgb_name): 1}


def test_a_map_decodes_each_file_once(tmp_path, box, decoded):
    root = box.folder(tmp_path / "recording", n=6)
    config = gsfusion(data__hold_out_every=3, data__hold_out_offset=1)
    run_mapping(str(root), config, folder=tmp_path / "run")
    assert kinds(decoded) == {"depth": 6, "rgb": 6}
    assert set(decoded.values()) == {1}


def test_a_check_decodes_each_file_once_for_all_trials(tmp_path, box, decoded):
    root = box.folder(tmp_path, n=12, depth_scale=900.0)
    check_recording(root, pictures=False)
    assert kinds(decoded) == {"depth": 12, "rgb": 12}
    assert set(decoded.values()) == {1}


def test_images_are_held_up_to_a_limit_and_are_copies(tmp_path, box, decoded):
    root = box.folder(tmp_path, n=3)
    depth_bytes = 4 * 64 * 48
    images = DecodedImages(2 * depth_bytes)
    sequence = folder(root)
    sequence = dataclasses.replace(sequence, decoded=images)
    first = sequence.depth_image(0)
    first.zero_()
    for i in (0, 1, 2, 0, 1, 2):
        assert bool(sequence.depth_image(i).any())
    assert images.n_bytes == images.limit_bytes
    assert [decoded["depth", f"00000{i}.png"] for i in range(3)] == [1, 1, 2]
