"""Keys of a ``transforms.json`` beside those that are used: which of them may change what a pose
means, and which are only named."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ....checks import shown
from ....errors import SequenceError
from ..image_changes import check_unchanged

_USED = re.compile(
    r"frames|file_path|transform_matrix|applied_(transform|scale)|camera_model|is_fisheye|w|h|fl_[xy]"
    r"|c[xy]|camera_angle_[xy]|k[1-4]|p[12]|time(stamp)?|depth_(file_)?path"
    r"|(depth_unit_scale_factor|integer_depth_scale|depth_scale|depth_type|is_euclidean_depth)"
)

_CHANGES_NOTHING = re.compile(
    r"aabb_scale|render_aabb\w*|scale|offset|up|ply_file_path|orientation_override"
    r"|auto_scale_poses_override|(train|val|test)_filenames|enable_depth_loading|sharpness|sharpen"
    r"|colmap_im_id|n_extra_learnable_dims|blur_score|manual_keyframe|center_depth|neighbors"
    r"|\w*(version|date|comment|description|author|software|app|device|id|index|idx|name)"
)
"""What other programs draw or train with: instant-ngp's ``scale`` and ``offset`` place its own
cube, and move no pose. And what only describes the file."""

_TOLD = {
    "mask_path": "masks are not used: what they hide is mapped too",
    "fisheye_crop_radius": "fisheye_crop_radius is not used: pixels beyond it are mapped too",
    "is_bad": "frames that are marked as bad (is_bad) are used",
    "rolling_shutter": "rolling_shutter is not used: all rows have the pose of the frame",
}
"""Keys that say which pixels or frames to leave out, or when rows were taken -> what is said about
them."""

_OF_AXES = re.compile(
    r"(?i)\w*(convention|coord(inate)?_?(sys(tem)?|frame)|axes|axis_?order|handed|opengl|opencv"
    r"|world_?(to|2)_?cam|w2c|cam(era)?_?(to|2)_?world|c2w|invert|extrinsic|flip_?yz)\w*|T_\w+"
)
"""Names that may say in which axes poses are, from where to where they lead, or of what."""

_OF_UNITS = re.compile(
    r"(?i)(\w+_)?(units?|unit_?scale(_?factor)?|scale_?factor)"
    r"|(world|scene|metric|pose|position|translation|trajectory)s?_?scale"
)
"""Names that may say that positions are not metres."""

_AS_READ = re.compile(
    r"(nerf|nerfstudio|blender|opengl|instantngp|c2w|cam(era)?(2|to)world|rightupback|rub"
    r"|righthanded|right)(\s*(axes|convention))?|m|met(er|re)s?"
)
"""Values of such names that say what is taken anyway, in small letters without spaces or signs."""

_TRUE_AS_READ = re.compile(r"(?i).*(opengl|cam(era)?_?(to|2)_?world|c2w|right_?hand|metric).*")
"""Names that say so when they are true."""


def check_poses_as_read(
    values: Mapping[str, Any], file: Path, *, unit_is_given: bool, camera_is_given: bool
) -> None:
    """Raise ``SequenceError`` where a key may say that poses have other axes, another direction or
    another unit than camera-to-world, OpenGL's axes and metres, or that images were changed.

    Args:
        values: Of the file, or of the file and a frame.
        file: For messages.
        unit_is_given: The user says how long a unit of the poses is.
        camera_is_given: The user gives the intrinsics of the images as they are stored.
    """
    for name, value in values.items():
        if _is_used(name) or "depth" in name.lower() or _is_as_read(name, value):
            continue
        if _OF_AXES.fullmatch(name):
            raise SequenceError(
                f"{file}: {name} = {shown(value)} may say that poses are not as nerfstudio's, "
                "camera-to-world with OpenGL's axes (right, up, back); write them so, or remove "
                "the key if it changes nothing"
            )
        if _OF_UNITS.fullmatch(name) and not unit_is_given:
            raise SequenceError(
                f"{file}: {name} = {shown(value)} may say that positions are not metres; give "
                "the length of one unit with --scale"
            )
    if not camera_is_given:
        beside_poses = {
            name: value
            for name, value in values.items()
            if not (_CHANGES_NOTHING.fullmatch(name) or _OF_UNITS.fullmatch(name))
        }
        check_unchanged(beside_poses, str(file))


def notes_on_unused(values: Mapping[str, Any], frames: Iterable[Mapping[str, Any]]) -> list[str]:
    """What is said about keys that are not used: a sentence for those whose meaning is known, and
    the names of all others."""
    entries = (values, *frames)
    given = dict.fromkeys(name for entry in entries for name, value in entry.items() if value)
    notes = [note for name, note in _TOLD.items() if name in given]
    unknown = [
        name
        for name in given
        if name not in _TOLD
        and not _is_used(name)
        and not _CHANGES_NOTHING.fullmatch(name)
        and not _OF_AXES.fullmatch(name)
        and not _OF_UNITS.fullmatch(name)
    ]
    if unknown:
        notes.append(f"keys that are not known and not used: {', '.join(unknown)}")
    return notes


def _is_used(name: str) -> bool:
    return bool(_USED.fullmatch(name))


def _is_as_read(name: str, value: Any) -> bool:
    """Whether a value of such a name says what is taken anyway, or nothing."""
    if isinstance(value, bool):
        return value == bool(_TRUE_AS_READ.fullmatch(name))
    if isinstance(value, int | float):
        return value == 1
    if isinstance(value, str):
        return bool(_AS_READ.fullmatch(re.sub(r"[\s_-]", "", value).lower())) or not value
    return value is None
