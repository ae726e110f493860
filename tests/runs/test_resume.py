"""Checkpoints whose checksums are right and whose content no run can have come to: each is refused
with a sentence."""

import copy
import dataclasses
import itertools
import json
import shutil
from typing import Any

import cv2
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun, resume_mapping, run_mapping
from gsfusion_nb.runs.checkpoint import save_checkpoint
from gsfusion_nb.runs.map_state import read_map_state, write_map_state
from gsfusion_nb.runs.resume import load_run
from gsfusion_nb.runs.run_folder import CHECKPOINTS
from gsfusion_nb.runs.sound_state import check_values

ROOM: dict[str, Any] = {"n_frames": 240, "width": 96, "height": 72}
DATA: dict[str, Any] = {"data__stop": 5, "data__hold_out_every": 0}
FEW: dict[str, Any] = {"window__iterations": 2, "keyframes__iterations": 2}
SETTINGS = {
    "gsfusion": gsfusion(
        "online",
        **DATA,
        tsdf__voxel_size_m=0.1,
        sh_degree=1,
        keyframe_min_seeds=5,
        optim__global_iterations=2,
    ),
    "rtg_slam": rtg_slam("room", data__width=0, data__height=0, **DATA, **FEW),
    "tracked": rtg_slam(
        "room",
        data__width=0,
        data__height=0,
        **DATA,
        **FEW,
        tracking__poses="tracked",
        tracking__back_end=True,
    ),
}


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """What checkpoints of interrupted runs hold: each with a step of the optimisation after the
    scan."""
    found = {}
    for name, config in SETTINGS.items():
        folder = tmp_path_factory.mktemp(name)
        sequence = open_sequence("room", data=config.data, **ROOM)
        with use_backend("auto"):
            run = MappingRun(sequence, make_mapper(config), source={"path_or_name": "room", **ROOM})
            for _ in itertools.chain(run.online(), itertools.islice(run.optimise(), 1)):
                pass
            save_checkpoint(run, folder)
        found[name] = CheckpointStore(folder / CHECKPOINTS).load().state
    return found


def put(*path, value):
    """A change: the value at ``path`` is another one; a function is called with the old one."""

    def change(state):
        *holders, last = path
        for key in holders:
            state = state[key]
        state[last] = value(state[last]) if callable(value) else value

    return change


def filled(index, number):
    """A copy of a tensor with ``number`` at ``index``."""

    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = number
        return tensor

    return change


VOLUME = ("mapper", "volume")
DATA_SETTINGS = ("mapper", "config", "data")
FIRST_KEYFRAME = ("mapper", "keyframes", 0)
ROWS = ("mapper", "gaussians", "rows")


def less(value):
    return value[:-1]


def more(value):
    return (
        torch.cat([value, value[-1:]]) if isinstance(value, torch.Tensor) else [*value, value[-1]]
    )


def in_double(value):
    return value.double()


def doubled(value):
    return 2 * value


CHANGES = {
    "gsfusion": [
        (
            put(*ROWS, "xyz_W", value=filled((3, 1), float("nan"))),
            "rows/xyz_W must be finite numbers, got NaN",
        ),
        (
            put(
                *ROWS,
                "exp_avg.sh",
                value=filled((0, 0, 0), float("inf")),
            ),
            "rows/exp_avg.sh must be finite numbers",
        ),
        (
            put(*ROWS, "xyz_W", value=in_double),
            r"rows/xyz_W must be .* of float32, got .* of float64",
        ),
        (put(*ROWS, "quat", value=less), "rows/|size|expanded"),
        (put(*ROWS, "tag", value=more), "rows/|size|expanded"),
        (put(*ROWS, "opacity_logit", value=lambda x: x[:1]), "opacity_logit must be a tensor"),
        (put(*ROWS, "last_step", value=filled(2, 99)), "last_step"),
        (
            put(*ROWS, "birth_frame", value=filled(2, -7)),
            "birth_frame of the Gaussians must be from -1",
        ),
        (
            put("mapper", "gaussians", "step_count", value=float("nan")),
            "step_count must be a whole number",
        ),
        (
            put("mapper", "gaussians", "step_count", value=[3]),
            "step_count must be one value, got a list",
        ),
        (
            put("mapper", "gaussians", "more", value=1),
            "mapper/gaussians/more must be nothing of this name",
        ),
        (put("mapper", "n_frames", value=4), "4 frames of the mapper, 5 poses"),
        (put("mapper", "n_frames", value=-5), "n_frames must be a whole number of at least 0"),
        (
            put("mapper", "localiser", "poses", value=filled((2, 0, 0), 9.0)),
            "poses must be camera-to-world poses, got",
        ),
        (put("mapper", "localiser", "poses", value=less), "5 frames of the mapper, 4 poses"),
        (put("mapper", "localiser", "poses", value=in_double), "poses|dtype"),
        (
            put("mapper", "localiser", "frame_indices", value=filled(0, -3)),
            "index -3, expected at least 0",
        ),
        (
            put("mapper", "keyframes", value=less),
            "keyframe . of the reports of a state is not among its keyframes",
        ),
        (put("mapper", "keyframes", value=more), "a state has a keyframe twice"),
        (put(*FIRST_KEYFRAME, "T_WC", value=doubled), "T_WC must be camera-to-world poses"),
        (
            put(*FIRST_KEYFRAME, "rgb_u8", value=less),
            r"rgb_u8 must be an image of 96 x 72 pixels .*got a tensor \[71",
        ),
        (
            put(*FIRST_KEYFRAME, "rgb_u8", value=lambda x: x.int()),
            "rgb_u8 must be an image .* of torch.uint8",
        ),
        (put(*FIRST_KEYFRAME, "index", value=77), "keyframe"),
        (put(*FIRST_KEYFRAME, "gain", value=torch.zeros(2)), "gain must be three brightnesses"),
        (put(*FIRST_KEYFRAME, "camera", "fx", value=float("inf")), "fx must be a finite number"),
        (put("mapper", "passes", "queue", value=[0, 0]), "wait for keyframes"),
        (put("mapper", "passes", "queue", value=[88]), "wait for keyframes"),
        (put("mapper", "passes", "done", value=True), "done must be a number, got True"),
        (put("run", "timestamps_s", value=less), "5 reports of frames, 4 times"),
        (put("run", "next_position", value=2), "5 reports of frames, but goes on at position 2"),
        (put("run", "is_optimised", value="yes"), "is_optimised"),
        (put("run", "global_losses", value=3.0), "global_losses must be a list"),
        (put("run", "online_scores", value=[1.0]), "online_scores must be a dictionary"),
        (
            put("run", "seconds_global", value=float("nan")),
            "seconds_global must be a finite number",
        ),
        (put("run", "warnings", value="a word"), "run/warnings must be a list, got a str"),
        (put("run", "warnings", value=[1.0]), "run/warnings/0 must be a text, got 1.0"),
        (put("run", "endings", value=[1.0]), "run/endings/0 must be a text, got 1.0"),
        (put("run", "bad_in_a_row", value=1 << 70), "bad_in_a_row must be a whole number"),
        (put("random", "python", 0, value=9), "python|version|state"),
        (
            put(*VOLUME, "W", value=filled((0, 3), -1.0)),
            "W must be at least 0 in every voxel, got -1",
        ),
        (
            put("run", "next_position", value=9),
            "interrupted after 9 frames, but room has 5 now; expected",
        ),
    ],
    "settings": [
        (
            put(*DATA_SETTINGS, "repair", "cx", value=30.0),
            "was mapped with the camera .*, but room",
        ),
        (put("mapper", "config", "seeding", "options", value={"a": 1}), "has no options"),
    ],
}


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [(name, *rest) for name, changes in CHANGES.items() for rest in changes],
)
def test_what_no_run_can_have_come_to_is_refused(states, tmp_path, name, change, sentence):
    state = copy.deepcopy(states["gsfusion" if name == "settings" else name])
    change(state)
    CheckpointStore(tmp_path / CHECKPOINTS).save(state)
    with pytest.raises(ValueError, match=sentence) as caught:
        load_run(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert len(str(caught.value)) < 1100


@pytest.mark.parametrize("name", SETTINGS)
def test_what_is_not_changed_is_taken(states, tmp_path, name):
    CheckpointStore(tmp_path / CHECKPOINTS).save(states[name])
    run = load_run(tmp_path)
    assert (len(run.steps), run.mapper.n_frames, run.warnings) == (5, 5, [])


def test_a_checkpoint_of_a_version_with_other_keys_is_a_sentence(states, tmp_path):
    state = copy.deepcopy(states["rtg_slam"])
    for frame in state["mapper"]["window"]:
        frame["picture"] = frame.pop("colour")
    CheckpointStore(tmp_path / CHECKPOINTS).save(state)
    with pytest.raises(ValueError, match="is damaged or from another version: TypeError"):
        load_run(tmp_path)


class Killed(BaseException):
    """Ends a run as a kill does: nothing is saved any more."""


@pytest.fixture
def killed(killed_with):
    """The folders of a run that was killed after its third frame of five, and of its recording."""
    return killed_with(None)


@pytest.fixture
def killed_with(scene, tmp_path, monkeypatch):
    """``killed_with(rule)``: the same with another seeding rule."""
    return lambda rule: _killed(scene, tmp_path, monkeypatch, rule)


def _killed(scene, tmp_path, monkeypatch, rule):
    from gsfusion_nb.runs import CheckpointEvery, driver

    shutil.copytree(scene, tmp_path / "wall")
    config = gsfusion(
        "replica",
        sh_degree=0,
        tsdf__voxel_size_m=0.08,
        seeding__quadtree_threshold=0.0005,
        keyframe_min_seeds=5,
        optim__global_iterations=1,
        data__hold_out_every=4,
        data__hold_out_offset=2,
    )

    class Watch:
        def frame_mapped(self, mapper, frame, report):
            if mapper.n_frames == 4:
                raise Killed

        def finished(self, mapper, mesh, metrics):
            pass

    with monkeypatch.context() as patch:
        patch.setattr(driver, "_rescue", lambda *_: None)
        with pytest.raises(Killed):
            run_mapping(
                tmp_path / "wall",
                config,
                folder=tmp_path / "run",
                evaluate=False,
                watch=Watch(),
                checkpoints=CheckpointEvery(seconds=0, frames=1),
                seeding=rule,
            )
    return tmp_path / "run", tmp_path / "wall"


def edit_intrinsics(wall, name, factor):
    path = wall / "intrinsics.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {name: values[name] * factor}))


def invert(wall):
    path = str(wall / "rgb/000005.png")
    image = cv2.imread(path)
    assert image is not None
    cv2.imwrite(path, 255 - image)


def one_digit(wall):
    path = wall / "poses.txt"
    path.write_text(path.read_text().replace("5", "6", 1))


def one_more(wall):
    for kind in ("rgb", "depth"):
        shutil.copyfile(wall / f"{kind}/000006.png", wall / f"{kind}/000007.png")
    (wall / "poses.txt").write_text(
        (wall / "poses.txt").read_text() + "1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1\n"
    )


def one_less(wall):
    for kind in ("rgb", "depth"):
        (wall / f"{kind}/000006.png").unlink()


CHANGES_CHANGED_DATA = {
    "an image not mapped yet": (invert, "rgb/000005.png (changed)"),
    "a pose": (one_digit, "poses.txt (changed)"),
    "the intrinsics": (lambda wall: edit_intrinsics(wall, "fx", 1.01), "intrinsics.json (changed)"),
    "a frame more": (one_more, "poses.txt (changed)"),
    "a frame less": (one_less, "rgb/000006.png (deleted)"),
    "a held-out image": (
        lambda wall: (wall / "depth/000006.png").write_bytes(b""),
        "depth/000006.png (changed)",
    ),
}


@pytest.mark.parametrize("change", CHANGES_CHANGED_DATA)
def test_changed_data_are_refused_and_named(killed, change):
    folder, wall = killed
    act, named = CHANGES_CHANGED_DATA[change]
    act(wall)
    with pytest.raises(SequenceError) as refused:
        resume_mapping(folder, evaluate=False)
    assert f"{wall}/{named}" in str(refused.value)


def test_a_rule_goes_on_with_the_modules_beside_its_file_and_no_others(killed_with, tmp_path):
    """They are in the run's folder; an edit there is another key, and is refused."""
    (tmp_path / "mine").mkdir()
    helper = tmp_path / "mine" / "thin.py"
    helper.write_text("STEP = 3\n")
    file = helper.with_name("rules.py")
    file.write_text("import thin\ndef thinned(ctx):\n    return ctx.cells()[:: thin.STEP]\n")
    folder, _ = killed_with(f"{file}:thinned")
    shutil.rmtree(helper.parent)
    shutil.copytree(folder, tmp_path / "copy")
    named = {"seeding": f"{folder / 'rule.py'}:thinned", "evaluate": False}
    assert resume_mapping(folder, **named).run.status == "complete"
    kept = tmp_path / "copy" / "rule_modules" / "thin.py"
    assert kept.read_text() == "STEP = 3\n"
    kept.write_text("STEP = 4\n")
    with pytest.raises(SequenceError, match=r"not as it was when .* began; different: .*file thin"):
        resume_mapping(
            tmp_path / "copy", seeding=f"{tmp_path / 'copy' / 'rule.py'}:thinned", evaluate=False
        )


def test_the_same_data_go_on(killed):
    folder, wall = killed
    (wall / "notes.txt").write_text("not read by a run")
    whole = resume_mapping(folder, evaluate=False)
    assert (whole.run.status, whole.run.warnings) == ("complete", [])


@pytest.mark.parametrize("name", ["gsfusion", "rtg_slam", "gps_slam"])
def test_keyframes_with_holes_in_their_depth_are_sound(name, tmp_path):
    """Where most of a part of the picture has no depth, its farthest depth is infinite: in every
    recording of a real camera."""
    config = SETTINGS.get(name) or gps_slam("room", data__width=0, data__height=0, **DATA)
    mapper = make_mapper(config)
    for frame in list(open_sequence("room", data=config.data, **ROOM).mapping)[:2]:
        depth_m = frame.depth_m.clone()
        depth_m[:30] = 0.0
        mapper.step(dataclasses.replace(frame, depth_m=depth_m))
    state = mapper.state_dict()
    farthest_m = state["keyframes"][0]["farthest_m"]
    assert farthest_m.isinf().any()
    check_values({"mapper": state})
    write_map_state(tmp_path / "state.zip", mapper)
    assert torch.equal(
        read_map_state(tmp_path / "state.zip")["keyframes"][0]["farthest_m"], farthest_m
    )
    for number in (float("nan"), 0.0, -float("inf")):
        farthest_m[0, 0] = number
        with pytest.raises(SequenceError, match="farthest_m must be distances above 0"):
            check_values({"mapper": state})
