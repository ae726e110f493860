"""The lines of a growing poses.txt, each bound to the image that it is written for."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ...errors import shown
from ..recorded.pose_lines import image_key, image_number, parsed_pose, split_name
from ..sequence import BadFrameError, SequenceError
from .appended_lines import AppendedLines


class PosesOfImages:
    """Pose lines by image, as they are appended.

    A line "name r00 r01 ... r33" belongs to the image of that name. Lines of numbers alone belong to images by the
    number at the end of their names: the first line to the image with the number ``first_image``, and so on; a missing
    image leaves its line unused.

    Args:
        path: The file; it may not exist yet.
    """

    def __init__(self, path: Path):
        self.path = path
        self.first_image: int | None = None
        """Number in the name of the image that the first line belongs to; ``None``: 0, and the image must be there."""
        self._lines = AppendedLines(path)
        self._named: bool | None = None
        self._of_name: dict[str, str] = {}
        self._n_named = 0
        self._first_seen: int | None = None
        self._last = -1
        """Line of the last image that was passed."""

    def update(self, *, final: bool = False) -> bool:
        """Read what was appended; ``final`` counts a last line without an end. Whether anything was new."""
        changed = self._lines.update(final=final)
        if self._named is None and (first := self._lines.take(0)) is not None:
            self._named = split_name(first)[0] is not None
        while self._named and self._n_named < self._lines.n_lines:
            line = self._lines.take(self._n_named)
            self._n_named += 1
            if line is not None:
                self._of_name[image_key(split_name(line)[0] or line.split()[0])] = line
        return changed

    def is_there(self, image: Path) -> bool:
        """The line of an image is written.

        Raises:
            SequenceError: the lines have no names, and the image's name does not tell its line.
            BadFrameError: the same line belongs to an image before it.
        """
        if self._named is None:
            return False
        if not self._named and self._place(image) <= self._last:
            raise BadFrameError(f"{image} has the same number as an image before it; expected a number of its own")
        return self._line(image) is not None

    def passed(self, image: Path) -> None:
        """An image was taken, or left out."""
        number = image_number(image)
        if number is not None:
            self._first_seen = number if self._first_seen is None else self._first_seen
            self._last = max(self._last, number - (self.first_image or 0))

    def take(self, image: Path) -> tuple[Float[Tensor, "1 4 4"], str]:
        """The pose of an image, not yet checked, and where it is written.

        Raises:
            BadFrameError: the line is not 16 numbers.
        """
        source = f"{self.path} pose {f'of {image.stem}' if self._named else self._place(image)}"
        line = self._line(image)
        assert line is not None
        self._of_name.pop(image_key(image.stem), None)
        try:
            return parsed_pose(split_name(line)[1]).reshape(1, 4, 4), source
        except ValueError:
            raise BadFrameError(f"{source} must be 16 row-major numbers, got {shown(line)}") from None

    def position(self, image: Path) -> int | None:
        """Which line is the image's, from 0; ``None`` where lines have names."""
        return None if self._named is not False else self._place(image)

    def _line(self, image: Path) -> str | None:
        return self._of_name.get(image_key(image.stem)) if self._named else self._lines.take(self._place(image))

    def _place(self, image: Path) -> int:
        """The image's line by its number."""
        number = image_number(image)
        first = number if self._first_seen is None else self._first_seen
        if number is None or (self.first_image is None and first != 0):
            raise SequenceError(
                f"it is not clear which line of {self.path} belongs to {image}: expected images numbered from 0 "
                "(000000.jpg, 000001.jpg, ...), or the number of the first line's image as first_image in "
                "intrinsics.json, or each line to begin with the name of its image"
            )
        return number - (self.first_image or 0)
