"""Saved states."""

import pytest
import torch

from gsfusion_nb.export import checkpoint, load_checkpoint, save_checkpoint


def test_round_trip(tmp_path, generator):
    state = {
        "xyz": torch.randn(5, 3, generator=generator),
        "step": 7,
        "rate": 0.1,
        "done": False,
        "name": "ärger",
        "none": None,
        "keyframes": [1, 2, (3, "a")],
        "nested": {"index": torch.arange(4), 3: torch.zeros(0, 3)},
        "generator": generator.get_state(),
    }
    save_checkpoint(tmp_path / "c.pt", state)
    back = load_checkpoint(tmp_path / "c.pt")
    assert list(back) == list(state)
    assert torch.equal(back["xyz"], state["xyz"])
    assert back["nested"][3].shape == (0, 3)
    assert back["keyframes"] == [1, 2, (3, "a")]
    assert {k: back[k] for k in ("step", "rate", "done", "name", "none")} == {
        k: state[k] for k in ("step", "rate", "done", "name", "none")
    }
    expected = torch.rand(3, generator=generator)
    again = torch.Generator()
    again.set_state(back["generator"])
    assert torch.equal(torch.rand(3, generator=again), expected)


def test_a_view_is_stored_without_the_rest_of_its_buffer(tmp_path):
    buffer = torch.zeros(1_000_000, requires_grad=True)
    save_checkpoint(tmp_path / "c.pt", {"rows": buffer[:10]})
    assert (tmp_path / "c.pt").stat().st_size < 10_000
    back = load_checkpoint(tmp_path / "c.pt")["rows"]
    assert back.shape == (10,)
    assert not back.requires_grad


def test_refuses_what_could_not_be_read_back(tmp_path):
    with pytest.raises(TypeError, match=r"state\['a'\]\[1\] must be a tensor, number"):
        save_checkpoint(tmp_path / "c.pt", {"a": [1, object()]})
    with pytest.raises(TypeError, match="strings or integers as keys"):
        save_checkpoint(tmp_path / "c.pt", {"a": {1.5: 2}})
    assert list(tmp_path.iterdir()) == []


def test_errors_are_sentences(tmp_path, monkeypatch):
    path = tmp_path / "c.pt"
    with pytest.raises(FileNotFoundError, match=r"c\.pt does not exist; expected a checkpoint"):
        load_checkpoint(path)
    save_checkpoint(path, {"a": torch.zeros(1000)})
    whole = path.read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 4):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"c\.pt is not readable as a checkpoint"):
            load_checkpoint(path)
    torch.save({"a": 1}, path)
    with pytest.raises(ValueError, match="is a PyTorch file but not a gsfusion_nb checkpoint"):
        load_checkpoint(path)
    monkeypatch.setattr(checkpoint, "VERSION", 2)
    save_checkpoint(path, {})
    monkeypatch.undo()
    with pytest.raises(ValueError, match="has checkpoint version 2; this program reads version 1"):
        load_checkpoint(path)


def test_code_in_a_file_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (exec, ("raise SystemExit",))

    torch.save({"state": Evil()}, tmp_path / "c.pt")
    with pytest.raises(ValueError, match="not readable as a checkpoint"):
        load_checkpoint(tmp_path / "c.pt")


def test_interrupted_saving_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "c.pt"
    save_checkpoint(path, {"step": 1})

    def half(content, target):
        target.write_bytes(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, {"step": 2})
    assert load_checkpoint(path) == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]
