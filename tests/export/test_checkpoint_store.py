import hashlib
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from gsfusion_nb.export import CheckpointStore, checkpoint_values


def state(seed: int = 0) -> dict:
    generator = torch.Generator().manual_seed(seed)
    return {
        "rows": torch.rand(50_000, 3, generator=generator),
        "mask": torch.rand(9000, generator=generator) > 0.5,
        "small": [torch.eye(4, dtype=torch.float64), torch.tensor(7), torch.zeros(0, 3)],
        "one": torch.ones(1).expand(7)[:1],
        "bits": torch.arange(5000, dtype=torch.float32).to(torch.bfloat16),
        "plain": {
            "n": 3,
            "x": 0.1 + 0.2,
            "inf": float("inf"),
            "none": None,
            "pair": (1, "zwei", [True, torch.ones(2)]),
        },
    }


def same(a, b) -> bool:
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def test_what_is_saved_comes_back(tmp_path):
    store = CheckpointStore(tmp_path / "c")
    assert not store.exists
    store.save(state())
    loaded = CheckpointStore(tmp_path / "c").load()
    assert same(loaded.state, state())
    assert (loaded.number, loaded.passed_over) == (1, "")


def test_a_view_is_saved_without_the_rest_of_its_buffer(tmp_path):
    buffer = torch.zeros(1_000_000, requires_grad=True)
    CheckpointStore(tmp_path).save({"rows": buffer[:10], "many": buffer[:5000]})
    assert (tmp_path / "000001.state").stat().st_size < 30_000
    back = CheckpointStore(tmp_path).load().state
    assert back["rows"].shape == (10,)
    assert not back["rows"].requires_grad


def test_what_is_constant_is_written_once(tmp_path):
    store = CheckpointStore(tmp_path)
    image = torch.rand(300, 300)
    rows = torch.rand(300, 300)
    store.save({"image": image, "rows": [rows, image]}, constant=[image])
    before = image.clone()
    image += 1
    rows += 1
    store.save({"image": image, "rows": rows}, constant=[image])
    assert (tmp_path / "000002.state").stat().st_size < 1.1 * rows.nbytes
    back = CheckpointStore(tmp_path).load().state
    assert torch.equal(back["image"], before)
    assert torch.equal(back["rows"], rows)
    # images are read when they are used: all together may be more than memory holds
    if sys.platform == "linux":
        assert str(tmp_path / "000001.constants") in Path("/proc/self/maps").read_text()
    again = CheckpointStore(tmp_path)
    again.load()
    other = torch.rand(300, 300)
    for _ in range(3):
        again.save({"image": other}, constant=[other])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "000003.constants",
        "000003.copy",
        "000004.json",
        "000004.state",
        "000005.json",
        "000005.state",
    ]
    assert torch.equal(again.load().state["image"], other)
    again.remove()
    assert not tmp_path.exists()


def test_parts_of_a_large_tensor_that_did_not_change_are_not_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint_values, "PART_BYTES", 40_000)
    monkeypatch.setattr(checkpoint_values, "COPIED_BYTES", 10_000)
    store = CheckpointStore(tmp_path)
    rows = torch.rand(100, 1000, generator=torch.Generator().manual_seed(0))
    buffer = torch.cat([rows, rows])

    def written() -> list[int]:
        store.save({"rows": buffer[:100], "small": torch.arange(3)})
        assert same(
            CheckpointStore(tmp_path).load().state,
            {"rows": buffer[:100], "small": torch.arange(3)},
        )
        parts = [
            len(torch.load(path, weights_only=True))
            for path in sorted(tmp_path.glob("*.constants"))
        ]
        # at most twice what is needed, besides that of the checkpoint before
        assert 10 <= sum(parts) <= 20 + 10
        return parts

    assert written() == [10]
    buffer[55] += 1
    assert written() == [10, 1]
    assert (tmp_path / "000002.constants").stat().st_size < 1.2 * 40_000
    buffer[:60] += (
        1  # less than half of the first file is needed: the rest of it moves at the next checkpoint
    )
    assert written() == [10, 1, 6]
    assert written() == [10, 6, 4]
    assert written() == [6, 4]


@pytest.mark.parametrize("name", ["000003.json", "000003.state"])
@pytest.mark.parametrize("damage", ["truncated", "a flipped bit", "gone"])
def test_a_damaged_checkpoint_is_recognised_and_the_one_before_is_used(tmp_path, name, damage):
    store = CheckpointStore(tmp_path)
    for seed in range(3):
        store.save(state(seed))
    path = tmp_path / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content[: len(content) // 2] if damage == "truncated" else content)
    if damage == "gone":
        path.unlink()
    loaded = CheckpointStore(tmp_path).load()
    assert loaded.number == 2
    assert same(loaded.state, state(1))
    assert bool(loaded.passed_over) == (damage != "gone" or name.endswith("state"))
    for path in tmp_path.iterdir():
        path.write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="cannot be used"):
        CheckpointStore(tmp_path).load()
    with pytest.raises(FileNotFoundError, match="holds no checkpoint"):
        CheckpointStore(tmp_path / "other").load()


@pytest.mark.parametrize("damage", ["truncated", "a flipped bit", "gone"])
def test_a_damaged_file_that_all_checkpoints_need_is_read_from_its_copy(tmp_path, damage):
    """Both checkpoints would be lost with it."""
    image = torch.rand(300, 300)
    store = CheckpointStore(tmp_path)
    for n in range(3):
        store.save({"image": image, "n": n}, constant=[image])
    path = tmp_path / "000001.constants"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content[: len(content) // 2] if damage == "truncated" else content)
    if damage == "gone":
        path.unlink()
    loaded = CheckpointStore(tmp_path).load()
    assert (loaded.number, loaded.state["n"], loaded.passed_over) == (3, 2, "")
    assert torch.equal(loaded.state["image"], image)
    assert len(loaded.copies) == 1
    assert "000001.constants is damaged" in loaded.copies[0]
    (tmp_path / "000001.copy").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match=r"000001\.constants"):
        CheckpointStore(tmp_path).load()


def test_on_a_disk_that_is_nearly_full_nothing_is_copied(tmp_path, monkeypatch):
    image = torch.rand(300, 300)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=3 * image.nbytes))
    store = CheckpointStore(tmp_path)
    for _ in range(2):
        store.save({"image": image}, constant=[image])
    assert not list(tmp_path.glob("*.copy"))
    assert torch.equal(CheckpointStore(tmp_path).load().state["image"], image)


def test_what_cannot_be_saved_is_named(tmp_path):
    with pytest.raises(TypeError, match=r"state\['a'\]\[1\] must be a tensor, number"):
        CheckpointStore(tmp_path).save({"a": [1, object()]})
    with pytest.raises(TypeError, match="must have strings as keys, got 1"):
        CheckpointStore(tmp_path).save({"a": {1: 2}})


@pytest.mark.parametrize("version", [2, 99])
def test_another_version_is_refused(tmp_path, version):
    CheckpointStore(tmp_path).save(state())
    path = tmp_path / "000001.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": version}))
    with pytest.raises(
        ValueError,
        match=f"expected a gsfusion_nb checkpoint of version 7, got version {version}: map",
    ):
        CheckpointStore(tmp_path).load()


def with_right_checksums(folder: Path, name: str, content) -> None:
    """Put ``content`` into a file of a checkpoint, as somebody would who means harm."""
    torch.save(content, folder / name)
    document = json.loads((folder / "000001.json").read_text())
    document["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / "000001.json").write_text(json.dumps(document))


def test_a_tensor_of_more_values_than_are_stored_is_refused(tmp_path):
    CheckpointStore(tmp_path).save(state())
    with_right_checksums(tmp_path, "000001.state", {"rows": torch.zeros(1).expand(2_500_000_000)})
    with pytest.raises(
        ValueError,
        match=r"000001\.state has a tensor \[2500000000\] of more values than are stored",
    ):
        CheckpointStore(tmp_path).load()


def test_a_part_that_occurs_a_thousand_times_is_refused(tmp_path):
    CheckpointStore(tmp_path).save({"image": torch.rand(500_000)}, constant=())
    with_right_checksums(
        tmp_path, "000001.constants", {"000001.constants 0": torch.zeros(2_000_000)}
    )
    parts = {"rows": {"$parts": ["000001.constants 0"] * 1000}}
    with_right_checksums(tmp_path, "000001.state", parts)
    with pytest.raises(ValueError, match=r"its files of 8\.0 MB ask for 8\.0 GB of memory"):
        CheckpointStore(tmp_path).load()
