"""Chapter 6's checkers agree with the library; the paper's tables beside a reader's."""

import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.course import mapping
from gsfusion_nb.course.paper_tables import PAPER_TABLES, PaperComparison
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.optim import Keyframe


def test_the_reference_step_maps_as_the_library_does():
    ours, theirs = mapping._small_mapper(), mapping._small_mapper()
    for k in range(3):
        frame = mapping._wall(k)
        n = mapping._map_frame(ours, frame, ours._optimise_view)
        assert n == theirs.step(frame).n_seeds
    torch.testing.assert_close(ours.gaussians.params.xyz_W, theirs.gaussians.params.xyz_W, rtol=0, atol=0)
    assert len(ours.keyframes) == len(theirs.keyframes) == 1


def test_the_plan_is_the_librarys():
    optim = gsfusion().optim
    numbers = (optim.keyframe_iterations, optim.frame_iterations, optim.random_keyframe_iterations)
    assert numbers == (5, 3, 2)  # paper, section IV-A.4, Replica
    assert mapping._plan_frame(51, 3, *numbers, gsfusion().keyframe_min_seeds) == (True, 5, 0)
    assert mapping._plan_frame(50, 3, *numbers, gsfusion().keyframe_min_seeds) == (False, 3, 2)


def test_the_log_tells_key_frames_from_frames():
    mapper = GSFusion()
    log = mapping.Log(mapper)
    frame = mapping._wall(4)
    log(frame)
    log(Keyframe(index=2, rgb_u8=frame.rgb_u8, camera=frame.camera, T_WC=frame.T_WC))
    assert log.calls == [("frame", 4, 0), ("keyframe", 2, 0)]


def test_the_papers_tables_and_ours_beside_them():
    assert list(PAPER_TABLES) == ["IV", "V", "VI", "VII", "VIII"]
    table = PaperComparison("VII", {"with": {"PSNR": 20.0, "FPS": 30.0, "Gaussians": 1234, "MB": 3.0}})
    head, without, with_ = table.lines()
    assert head == ["random keyframe optimisation", "PSNR", "SSIM", "FPS", "Gaussians"]
    assert without == ["without", "- (24.22)", "- (0.849)", "- (9.7)", "-"]
    assert with_ == ["with", "20.00 (28.64)", "- (0.900)", "30.0 (9.7)", "1,234"]
    thresholds = PaperComparison("VIII", {k: {"PSNR": 20.0} for k in ("10", "200", "50")})
    assert [row[0] for row in thresholds.lines()[1:]] == ["10", "40", "50", "90", "200"]
    assert "Table VII" in repr(table)
    with pytest.raises(KeyError, match="IV, V, VI, VII, VIII"):
        PaperComparison("III", {})
