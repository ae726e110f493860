"""Calibration files as trees of names and values: JSON, YAML of OpenCV and ORB-SLAM too, and lines
"name: value"."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ...config.values import tree_of
from ...files import parsing, read_object, read_text

WAYS = (
    "'fx fy cx cy [k1 k2 p1 p2 [k3 ...]]', the focal length alone, a 3x3 or 4x4 matrix, lines such "
    "as 'fx: 525', JSON (Open3D's, RealSense's, or fx fy cx cy), YAML (ORB-SLAM's, OpenCV's, "
    "ROS's, Kalibr's, RTAB-Map's), or ARKitScenes' .pincam"
)

Tree = Mapping[str, Any]


def tree_of_file(path: Path) -> Tree:
    """Names and values of a calibration file; empty for one that holds numbers without names.

    Raises:
        SequenceError: it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_object(path, f"the camera's intrinsics as {WAYS}")
    if suffix in (".yaml", ".yml"):
        return _yaml_tree(path)
    return {} if suffix == ".npy" else _named_values(read_text(path, WAYS), path)


class _CameraLoader(yaml.SafeLoader):
    """YAML without code, with OpenCV's matrices as plain groups."""


def _plain_group(loader: Any, node: Any) -> dict[str, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _CameraLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _plain_group)


def _yaml_tree(path: Path) -> Tree:
    """Names and values of a YAML file, also of one that OpenCV or ORB-SLAM wrote; names with dots
    become groups."""
    text = re.sub(r"^%YAML:[\d.]+", "", read_text(path, WAYS))
    with parsing(path, f"the camera's intrinsics as {WAYS}"):
        try:
            tree = yaml.load(text, _CameraLoader)  # a SafeLoader
        except yaml.YAMLError:
            tree = None
        if isinstance(tree, Mapping):
            return tree_of({str(name): value for name, value in tree.items()}, ".")
    return _named_values(text, path)


_LINE = re.compile(r"^\W*([A-Za-z_][\w.]*)[\"']?\s*[:=\s]\s*(\S.*?)\s*$")
_SECTION = re.compile(r"^\s*\[([^\]]*[A-Za-z][^\]]*)\]\s*$")


def _named_values(text: str, path: Path) -> Tree:
    """Names and numbers of lines such as "fx: 525", in sections such as "[rgb]"; empty where
    nothing has a name.

    Names with dots become groups: "Camera.fx: 525" is fx in the group Camera.
    """
    values: dict[str, Any] = {}
    section = ""
    for line in text.splitlines():
        heading = _SECTION.match(line)
        if heading:
            section = f"{heading[1]}."
            continue
        for part in re.split(r"[,;](?=\s*[A-Za-z_])", line):
            match = _LINE.match(part)
            if match and not line.lstrip().startswith(("#", "//")):
                values[section + match[1]] = _value(match[2])
    with parsing(path, f"the camera's intrinsics as {WAYS}"):
        return tree_of(values, ".")


def _value(text: str) -> Any:
    """A number, a list of numbers, or the text without its quotes; a comment behind it is left
    out."""
    text = re.sub(r"\s+(#|//).*", "", text)
    words = text.strip("[]() ").replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return text.strip("\"'")
    return numbers[0] if len(numbers) == 1 else numbers
