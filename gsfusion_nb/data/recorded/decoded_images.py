"""Images that were decoded, for whoever reads the same files again with other corrections."""

import threading
from collections.abc import Callable, Hashable

import numpy as np


class DecodedImages:
    """Images by what they were decoded from, within a limit of memory: those that came first.

    Args:
        limit_bytes: Of all images that are held.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.n_bytes = 0
        """Of the images that are held."""
        self._images: dict[Hashable, np.ndarray] = {}
        self._lock = threading.Lock()

    def get(self, key: Hashable, decode: Callable[[], np.ndarray]) -> np.ndarray:
        """A copy of the image of ``key``, which ``decode`` gives when it is not held."""
        with self._lock:
            image = self._images.get(key)
        if image is None:
            image = decode()
            self._add(key, image)
        return image.copy()

    def _add(self, key: Hashable, image: np.ndarray) -> None:
        with self._lock:
            if key not in self._images and self.n_bytes + image.nbytes <= self.limit_bytes:
                self._images[key] = image
                self.n_bytes += image.nbytes
