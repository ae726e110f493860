"""Checks of the tracking state in a checkpoint: sizes that fit together, and indices that exist."""

from typing import Any

import torch
from torch import Tensor

from ..checks import SAVED_RIGIDITY_ERROR, check_mask, check_pose, check_saved, check_whole
from ..errors import shown


def check_saved_pose(name: str, T: Tensor) -> None:
    """Raise ``ValueError`` unless ``T`` is a rigid transform in float64."""
    check_saved(name, T, (4, 4), torch.float64)
    check_pose(name, T, SAVED_RIGIDITY_ERROR)


def check_saved_features(name: str, features: dict[str, Tensor]) -> None:
    """Raise ``ValueError`` unless the columns are those of features and have one length."""
    check_saved(f"uv of {name}", features["uv"], ("M", 2))
    n = len(features["uv"])
    check_saved(f"descriptors of {name}", features["descriptors"], (n, 32), torch.uint8)
    check_saved(f"xyz_C of {name}", features["xyz_C"], (n, 3))
    check_mask(f"has_depth of {name}", features["has_depth"], (n,))
    check_saved(f"sigma_px of {name}", features["sigma_px"], (n,))


def check_saved_landmarks(state: dict[str, Any], n_features: list[int]) -> None:
    """Raise ``ValueError`` if a feature names a landmark that does not exist, or a landmark such a feature.

    Args:
        state: From ``Landmarks.state_dict``.
        n_features: Number of features of each keyframe.
    """
    birth = state["birth"]
    check_saved("birth of the landmarks", birth, ("L", 2), torch.int32)
    check_saved("xyz_B of the landmarks", state["xyz_B"], (len(birth), 3), torch.float64)
    check_saved("views of the landmarks", state["views"], (len(birth), 2), torch.int32)
    for n, landmarks in zip(n_features, state["of_feature"], strict=True):
        check_saved("landmarks of a keyframe", landmarks, (n,), torch.int32)
        if n and not -1 <= int(landmarks.min()) <= int(landmarks.max()) < len(birth):
            raise ValueError(f"landmarks of a keyframe must be from -1 to {len(birth) - 1}")
    row, feature = birth.long().unbind(1)
    known = (row >= 0) & (row < len(n_features))
    if not bool(known.all()) or bool(((feature < 0) | (feature >= torch.tensor(n_features or [0])[row])).any()):
        raise ValueError("the first observation of a landmark must be a feature of a keyframe")


def check_saved_back_end(state: dict[str, Any], n_features: list[int], n_landmarks: int) -> None:
    """Raise ``ValueError`` for edges or loops between keyframes that do not exist, or poses that are not rigid.

    Args:
        state: From ``BackEnd.state_dict``.
        n_features: Number of features of each keyframe.
        n_landmarks: Number of known landmarks.
    """
    n = len(n_features)
    for edge in state["edges"]:
        _check_edge(edge, n)
    for row, pairs in state["loops"]:
        check_whole("keyframe of a loop", row, 0, n - 1)
        check_saved("landmarks of a loop", pairs, ("I", 2), torch.int64)
        limits = torch.tensor([n_features[row], n_landmarks])
        if len(pairs) and bool(((pairs < 0) | (pairs >= limits)).any()):
            raise ValueError("a loop must name features and landmarks that exist")
    if len(state["loops"]) != sum(edge["kind"] == "loop" for edge in state["edges"]):
        raise ValueError("there must be one edge for each loop")
    for name in ("thumbnails", "as_added", "as_tracked"):
        if len(state[name]) != n:
            raise ValueError(f"{name} must be one for each of the {n} keyframes, got {len(state[name])}")
    for T_WC in (*state["as_added"], *state["as_tracked"]):
        check_saved_pose("pose of a keyframe", T_WC)
    for thumbnail in state["thumbnails"]:
        check_saved("depth of a keyframe", thumbnail, ("h", "w"))


def _check_edge(edge: dict[str, Any], n: int) -> None:
    for end in ("i", "j"):
        check_whole("keyframe of an edge", edge[end], 0, n - 1)
    check_saved_pose("T_ij of an edge", edge["T_ij"])
    check_saved("information of an edge", edge["information"], (6, 6), torch.float64)
    if edge["kind"] not in ("odometry", "landmarks", "loop"):
        raise ValueError(f"the kind of an edge must be odometry, landmarks or loop, got {shown(edge['kind'])}")
