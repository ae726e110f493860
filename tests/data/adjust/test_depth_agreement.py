"""Finding wrong conventions from the data alone."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.adjust.depth_agreement import check_sequence, depth_agreement
from gsfusion_nb.data.readers import folder
from gsfusion_nb.geometry import se3


def test_agreement_of_exact_data(tmp_path, box):
    seq = folder(box.folder(tmp_path))
    agreement = depth_agreement(seq[0], seq[1], step=1)
    assert agreement.median_m < 0.01  # the lookup takes the nearest of 64x48 pixels
    assert agreement.agreeing > 0.9
    same = depth_agreement(seq[0], seq[0], step=1)
    assert same.median_m < 1e-6
    assert same.overlap == same.agreeing == 1.0
    away = dataclasses.replace(seq[1], T_WC=torch.diag(torch.tensor([-1.0, 1, -1, 1])))
    assert depth_agreement(seq[0], away).overlap == 0.0


WRONG = {
    "inverted poses": (se3.inverse, 1000.0),
    "OpenGL axes": (lambda T: T @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)), 1000.0),
    "a depth scale that was 1000 instead of 5000": (lambda T: T, 200.0),
    "a depth scale that was 5000 instead of 1000": (lambda T: T, 5000.0),
}


@pytest.mark.parametrize("mistake", [None, *WRONG])
def test_names_the_mistake(tmp_path, box, mistake):
    root = box.folder(tmp_path, n=30, depth_scale=WRONG[mistake][1] if mistake else 1000.0)
    if mistake:
        lines = [" ".join(map(repr, WRONG[mistake][0](T).flatten().tolist())) for T in box.poses(30)]
        (root / "poses.txt").write_text("\n".join(lines))
    check = check_sequence(folder(root))
    assert check.ok == (mistake is None)
    assert (mistake or "as read") in check.best
    assert str(check).startswith("inconsistent" if mistake else "consistent")


def test_bad_frames_are_passed_over(tmp_path, box):
    root = box.folder(tmp_path, n=20)
    (root / "depth/000000.png").write_bytes(b"")
    assert check_sequence(folder(root)).ok
    for p in (root / "depth").iterdir():
        p.write_bytes(b"")
    with pytest.raises(SequenceError, match="has no two usable frames"):
        check_sequence(folder(root))


@pytest.mark.parametrize("name", ["redkitchen_mini48", "livingroom1_clean211"])
def test_real_sequences_are_consistent(shared_sequence, name):
    assert check_sequence(folder(shared_sequence(name))).ok
