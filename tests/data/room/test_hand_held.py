"""The made recording: what is stored, and that each mistake is the one that it names."""

import numpy as np
import pytest

from gsfusion_nb.config import RepairConfig
from gsfusion_nb.data import repaired, tum
from gsfusion_nb.data.room.hand_held import POSES_PER_IMAGE, HandHeld, write_hand_held

SMALL = HandHeld(
    n_images=8,
    width=32,
    height=24,
    noise="none",
    blurred=(2,),
    dark_after=0.7,
    colour_shift_px=(2.0, -1.0),
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = write_hand_held(tmp_path_factory.mktemp("made") / "hand_held", SMALL)
    return tum(folder, camera=SMALL.camera)


def test_its_depth_is_in_millimetres_and_its_poses_are_late(recording):
    room = SMALL.sequence
    repair = RepairConfig(depth_factor=5.0, pose_offset_s=SMALL.pose_delay_s)
    mended = repaired(recording, repair)
    lost = SMALL.n_images - len(recording)  # the first images are older than the first pose
    assert 1 <= lost <= 2
    true = room[POSES_PER_IMAGE * (lost + 2)]
    frame = mended[2]
    assert np.abs(frame.depth_m.numpy() - true.depth_m.numpy()).max() <= 0.0006
    # interpolated half-way between poses of 0.1 s
    assert (frame.T_WC - true.T_WC).abs().max() < 3e-3
    assert (recording[2].T_WC - true.T_WC).abs().max() > 5e-3


def test_its_colour_is_moved_dark_at_the_end_and_blurred(recording):
    lost = SMALL.n_images - len(recording)
    room = [
        SMALL.sequence[POSES_PER_IMAGE * (i + lost)].rgb_u8.numpy().astype(float)
        for i in range(len(recording))
    ]
    seen = [recording[i].rgb_u8.numpy().astype(float) for i in range(len(recording))]
    inner = np.abs(seen[1][4:-4, 6:-4] - room[1][5:-3, 4:-6]).mean()
    assert inner < 6 < np.abs(seen[1] - room[1]).mean()
    assert seen[-1].mean() < 0.85 * room[-1].mean()
    blurred = 2 - lost
    gradient = [np.abs(np.diff(image, axis=1)).mean() for image in (seen[blurred], room[blurred])]
    assert gradient[0] < 0.6 * gradient[1]


def test_nothing_is_overwritten(tmp_path):
    with pytest.raises(FileExistsError):
        write_hand_held(tmp_path, SMALL)
    with pytest.raises(ValueError, match="n_images must be between 2 and"):
        write_hand_held(tmp_path / "new", HandHeld(n_images=1))
    assert list(tmp_path.iterdir()) == []
