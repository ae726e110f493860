"""The examination: a recording is written with its fault and read again."""

from itertools import islice

import exam
import pytest
import torch

from gsfusion_nb.geometry import se3


@pytest.mark.ci
def test_a_recording_has_its_fault(tmp_path, monkeypatch):
    monkeypatch.setattr(exam, "N_FRAMES", 2)
    exam.write("c", tmp_path / "c.npz")
    right = exam.read(tmp_path / "c.npz")
    assert len(right) == 2
    for letter, (_, change) in exam.FAULTS.items():
        for frame, broken in zip(
            right[1:],
            islice(exam.frames_of(letter), 1, 2),
            strict=True,
        ):
            torch.testing.assert_close(change(frame, right[0]).depth_m, broken.depth_m)
            torch.testing.assert_close(change(frame, right[0]).T_WC, broken.T_WC)
    assert torch.equal(
        exam.FAULTS["b"][1](right[1], right[0]).T_WC,
        right[0].T_WC,
    )
    assert torch.equal(
        exam.FAULTS["d"][1](right[1], right[0]).T_WC,
        se3.inverse(right[1].T_WC),
    )
