"""Whether the state in a checkpoint is one that a run of this version can have come to.

Its checksums say that no disk changed it. They do not say who wrote it: a checkpoint may be
somebody else's, or that of a program with an error. Three things are looked at, before the run goes
on: every value by its name, sizes that have to agree (``state_agreement``), and whether the run
that was made of the state would write the same state again. The last finds what was converted,
filled up or passed over without a word.
"""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from ..checks import check_pose, check_whole, shown
from ..errors import SequenceError

COUNTS = frozenset(
    {
        "bad_in_a_row",
        "done",
        "frame_index",
        "height",
        "index",
        "lost_in_a_row",
        "n",
        "n_blocks",
        "n_earlier",
        "n_frames",
        "n_gaussians",
        "n_not_finite",
        "n_seeds",
        "n_steps",
        "n_taken",
        "n_unusable",
        "next_position",
        "queue",
        "sh_degree",
        "step",
        "step_count",
        "steps",
        "steps_taken",
        "turns",
        "width",
    }
)
"""Names of whole numbers that are never negative."""
NUMBERS = frozenset(
    {
        "cx",
        "cy",
        "fx",
        "fy",
        "global_losses",
        "inlier_share",
        "losses",
        "online_scores",
        "psnr_after_db",
        "psnr_before_db",
        "rms_m",
        "seconds",
        "seconds_global",
        "timestamp_s",
        "usual_fit",
        "weight",
    }
)
FLAGS = frozenset({"changed", "is_keyframe", "is_optimised"})
TEXTS = frozenset({"endings", "kind", "name", "status", "warnings"})
LISTS = frozenset({"endings", "global_losses", "losses", "queue", "turns", "usual_fit", "warnings"})
TABLES = frozenset({"counts", "online_scores", "seconds", "tracking"})
"""Dictionaries of numbers, with names that a system, or a score, gives."""
_OTHERS = frozenset({"index", "steps"})
"""Names of a number in one place and of a list or dictionary in another."""
MAY_BE_NAN = frozenset(
    {
        "global_losses",
        "losses",
        "online_scores",
        "pass_losses",
        "psnr_after_db",
        "psnr_before_db",
        "timestamps_s",
        "timestamp_s",
        "tracking",
        "features",
    }
)
"""Scores, losses and places of features that could not be measured, and the times of frames that
have none."""
POSES = frozenset({"T_WC", "poses", "given"})
_BYTES = torch.uint8
_FLOATS = torch.float32
IMAGES = {
    "colour": (_BYTES, _FLOATS),
    "depth_m": (_FLOATS,),
    "rgb": (_FLOATS,),
    "rgb_u8": (_BYTES,),
    "seen_depth_m": (_FLOATS,),
    "seen_rgb": (_FLOATS,),
}
"""Names of images, and the types of their pixels."""
_NOT_OF_A_MAP = ("config", "rule", "training", "data_files")
"""What is checked where it is read."""
_GOES_ON = (*_NOT_OF_A_MAP, "clock", "warnings")
"""What is another when the same state is written again: times, sentences."""
LARGEST_COUNT = 1 << 53
"""Largest whole number: what a float64 counts exactly."""


def check_values(value: Any, where: tuple[str, ...] = ()) -> None:
    """Check each value below ``value`` by its name.

    Raises:
        SequenceError: with the place in the state, and what was expected there.
    """
    _check_holder(value, where)
    if isinstance(value, dict):
        _check_images(value, where)
        for key, part in value.items():
            if key not in _NOT_OF_A_MAP:
                check_values(part, (*where, str(key)))
    elif isinstance(value, list | tuple):
        for i, part in enumerate(value):
            check_values(part, (*where, str(i)))
    elif isinstance(value, Tensor):
        _check_tensor(value, where)
    elif where[-1:] == ("T_WC",) and "keyframes" in where:
        raise _refusal(where, "a pose", _kind(value))
    elif value is not None:
        _check_plain(value, where)


def check_same(
    state: Any,
    expected_state: Any,
    where: tuple[str, ...] = (),
) -> None:
    """Check that what a run would write is what it was made of.

    Raises:
        SequenceError: with the first place where they differ.
    """
    if type(state) is not type(expected_state):
        raise _refusal(where, _kind(expected_state), _kind(state))
    if isinstance(state, dict):
        for key in [*state, *expected_state]:
            if key in state and key not in expected_state:
                raise _refusal((*where, str(key)), "nothing of this name", _kind(state[key]))
            # what is not in it came after it was written
            if key in state and key not in _GOES_ON:
                check_same(state[key], expected_state[key], (*where, str(key)))
    elif isinstance(state, list | tuple):
        if len(state) != len(expected_state):
            raise _refusal(where, f"{len(expected_state)} entries", f"{len(state)}")
        for i, (mine, theirs) in enumerate(zip(state, expected_state, strict=True)):
            check_same(mine, theirs, (*where, str(i)))
    elif isinstance(state, Tensor):
        _check_same_tensor(state, expected_state, where)
    elif state != expected_state and not (
        isinstance(state, float) and math.isnan(state) and math.isnan(expected_state)
    ):
        raise _refusal(where, shown(expected_state), shown(state))


def check_names(values: Any, where: str) -> None:
    """Raise ``SequenceError`` unless ``values`` are texts by name, or None."""
    if values is None:
        return
    texts = (*values, *values.values()) if isinstance(values, dict) else (values, None)
    if not all(isinstance(text, str) for text in texts):
        raise _refusal((where,), "texts by name", _kind(values))


def _check_holder(value: Any, where: tuple[str, ...]) -> None:
    """Lists and dictionaries are where they belong, and nowhere else."""
    holder, name = ("", "", *where)[-2:]
    is_entry = (
        holder in LISTS and holder != "usual_fit" and name.isdigit()
    ) or holder in TABLES - {"tracking"}
    if not is_entry and name in LISTS and not isinstance(value, list | tuple):
        raise _refusal(where, "a list", _kind(value))
    if not is_entry and name in TABLES and not isinstance(value, dict):
        raise _refusal(where, "a dictionary", _kind(value))
    is_number = name in (COUNTS | NUMBERS | FLAGS) - LISTS - TABLES - _OTHERS or (holder, name) == (
        "adam",
        "steps",
    )
    if (is_entry or is_number) and (
        value is None or isinstance(value, dict | list | tuple | Tensor)
    ):
        raise _refusal(where, "one value", _kind(value))


def _check_tensor(value: Tensor, where: tuple[str, ...]) -> None:
    if where[-1] in ("pass_losses", "timestamps_s", "frame_indices") and value.ndim != 1:
        raise _refusal(where, "one number for each", _kind(value))
    if where[-1] == "frame_indices" and value.dtype != torch.int64:
        raise _refusal(where, "whole numbers", _kind(value))
    if where[-1] == "farthest_m" and (
        tuple(value.shape) != (12, 16) or value.dtype != torch.float32
    ):
        raise _refusal(where, "a distance for each of 12 x 16 parts of the picture", _kind(value))
    if where[-1] == "farthest_m":  # infinite where most of a part has no depth
        if not (value > 0).all():
            raise _refusal(where, "distances above 0", "others, or NaN")
        return
    if where[-1] == "gain" and (tuple(value.shape) != (3,) or value.dtype != torch.float32):
        raise _refusal(where, "three brightnesses", _kind(value))
    finite = value.isfinite().all() if value.is_floating_point() and value.numel() else True
    if not (finite or MAY_BE_NAN & set(where)):
        raise _refusal(where, "finite numbers", "NaN or infinity")
    if value.is_complex() or (where[-1] in POSES and not value.is_floating_point()):
        raise _refusal(where, "floating-point numbers", _kind(value))
    of_keyframe = "keyframes" in where and "database" not in where
    if where[-1] == "T_WC" and of_keyframe and value.dtype != torch.float32:
        raise _refusal(where, "a pose of float32", _kind(value))
    if where[-1] in POSES and value.ndim >= 2:
        for T in value.reshape(-1, *value.shape[-2:]):
            try:
                check_pose("a pose", T)
            except ValueError as e:
                raise _refusal(where, "camera-to-world poses", str(e)) from None


def _check_plain(value: Any, where: tuple[str, ...]) -> None:
    names = set(where)
    if isinstance(value, str):
        if not names & (TEXTS | {"tracking", "back_end"}):
            raise _refusal(where, "no text", shown(value))
        return
    if names & TEXTS & LISTS:
        raise _refusal(where, "a text", shown(value))
    if "tracking" in names and isinstance(value, bool):
        return
    if isinstance(value, bool) or names & FLAGS:
        if not (isinstance(value, bool) and names & FLAGS):
            raise _refusal(where, "yes or no" if names & FLAGS else "a number", shown(value))
        return
    name = next((part for part in reversed(where) if not part.isdigit()), "")
    if name in COUNTS or "counts" in names:
        try:
            # frames of an earlier run are counted back from 0
            check_whole("it", value, -LARGEST_COUNT if name == "index" else 0, LARGEST_COUNT)
        except ValueError as e:
            raise _refusal(where, "a whole number of at least 0", str(e)) from None
    elif not math.isfinite(value) and not names & MAY_BE_NAN:
        raise _refusal(where, "a finite number", shown(value))
    elif abs(value) > LARGEST_COUNT and math.isfinite(value) and isinstance(value, int):
        raise _refusal(where, "a number that a computer counts to", shown(value))


def _check_images(values: dict[str, Any], where: tuple[str, ...]) -> None:
    """Images have the size of the camera beside them."""
    camera = values.get("camera")
    if not isinstance(camera, dict) or not {"width", "height"} <= camera.keys():
        return
    size = (camera["height"], camera["width"])
    for name, kinds in IMAGES.items():
        image = values.get(name)
        if isinstance(image, Tensor) and (
            tuple(image.shape[:2]) != size or image.dtype not in kinds
        ):
            shape_text = (
                f"an image of {size[1]} x {size[0]} pixels of {' or '.join(map(str, kinds))}"
            )
            raise _refusal((*where, name), shape_text, _kind(image))


def _check_same_tensor(state: Tensor, expected_state: Tensor, where: tuple[str, ...]) -> None:
    if state.dtype != expected_state.dtype or state.shape != expected_state.shape:
        raise _refusal(where, _kind(expected_state), _kind(state))
    mine = state.cpu()
    theirs = expected_state.cpu()
    if not torch.equal(mine, theirs):
        both_nan = (
            mine.isnan() & theirs.isnan()
            if mine.is_floating_point()
            else torch.zeros_like(mine, dtype=torch.bool)
        )
        if not bool(((mine == theirs) | both_nan).all()):
            raise _refusal(where, "values that a run keeps as they are", "others")


def _kind(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"a tensor {list(value.shape)} of {str(value.dtype).removeprefix('torch.')}"
    return "nothing" if value is None else f"a {type(value).__name__} ({shown(value, 40)})"


def _refusal(where: Iterable[str], expectation: str, came: str) -> SequenceError:
    return SequenceError(f"{'/'.join(where)} must be {expectation}, got {came}")
