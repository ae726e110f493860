"""Trajectories in the TUM format."""

import math

import pytest
import torch

from gsfusion_nb.export import read_trajectory_tum, write_trajectory_tum
from gsfusion_nb.geometry import se3


def test_by_hand(tmp_path):
    T = torch.eye(4)[None].clone()
    T[0, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # 90 degrees about z
    T[0, :3, 3] = torch.tensor([1.0, -2, 0.5])
    write_trajectory_tum(tmp_path / "t.txt", [1305031102.175304], T)
    comment, line = (tmp_path / "t.txt").read_text().splitlines()
    assert comment.startswith("#")
    values = [float(v) for v in line.split()]
    half = math.sqrt(0.5)
    assert values == pytest.approx(
        [1305031102.175304, 1, -2, 0.5, 0, 0, half, half],
        abs=1e-7,
    )
    assert len(line.split()[1].split(".")[1]) == 9


@pytest.mark.parametrize("n", [0, 1, 20])
def test_round_trip(tmp_path, generator, n):
    poses = se3.exp(torch.randn(n, 6, generator=generator, dtype=torch.float64) * 2)
    times = [1.3e9 + 0.0333 * i for i in range(n)]
    write_trajectory_tum(tmp_path / "t.txt", times, poses)
    times_back, back = read_trajectory_tum(tmp_path / "t.txt")
    assert times_back == times
    assert back.dtype == torch.float64
    assert torch.allclose(back, poses, rtol=0, atol=5e-9)


def test_agrees_with_the_published_form_of_a_real_sequence(shared_sequence):
    folder = shared_sequence("redkitchen_mini48")
    _, poses = read_trajectory_tum(folder / "trajectory_tum.txt")
    matrices = [
        [float(v) for v in line.split()] for line in (folder / "poses.txt").read_text().splitlines()
    ]
    expected = torch.tensor(matrices, dtype=torch.float64).reshape(-1, 4, 4)
    assert torch.allclose(poses, expected, rtol=0, atol=3e-6)  # 6 decimals in the file


def test_refuses_to_write_nonsense(tmp_path):
    with pytest.raises(ValueError, match="must hold 2 times, one per pose, got 1"):
        write_trajectory_tum(
            tmp_path / "t.txt",
            [0.0],
            torch.eye(4).repeat(2, 1, 1),
        )
    with pytest.raises(ValueError, match="finite"):
        write_trajectory_tum(
            tmp_path / "t.txt",
            [0.0],
            torch.full((1, 4, 4), float("nan")),
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 1 2 3", "8 finite numbers"),
        ("0 a b c 0 0 0 1", "8 finite"),
        ("0 nan 0 0 0 0 0 1", "8 finite"),
        ("0 0 0 0 0 0 0 2", "unit quaternion, got one of length 2"),
    ],
)
def test_reading_nonsense_names_the_line(tmp_path, line, message):
    (tmp_path / "t.txt").write_text("# comment\n\n0 0 0 0 0 0 0 1\n" + line + "\n")
    with pytest.raises(ValueError, match=rf"t\.txt line 4 must .*{message}"):
        read_trajectory_tum(tmp_path / "t.txt")
