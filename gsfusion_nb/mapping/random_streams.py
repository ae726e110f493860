"""The random numbers of a mapper, a stream for each use."""

import hashlib

import torch
from torch import Tensor


class RandomStreams:
    """Three generators that follow from one seed.

    A rule that draws more or fewer numbers than another changes neither which keyframes are
    revisited nor the order of the passes after the scan.

    Args:
        seed: Seed of the run, ``config.seed``.
    """

    def __init__(self, seed: int):
        self.rule = _generator(seed, "rule")
        """For the seeding rule: ``ctx.generator``."""
        self.keyframes = torch.Generator().manual_seed(seed)
        """For the views that are optimised while scanning."""
        self.passes = _generator(seed, "passes")
        """For the order of the keyframes in the passes after the scan."""

    def state_dict(self) -> dict[str, Tensor]:
        """State of each generator."""
        return {name: generator.get_state() for name, generator in vars(self).items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Set the generators to what ``state_dict`` returned."""
        for name, generator in vars(self).items():
            generator.set_state(state[name])


def _generator(seed: int, stream: str) -> torch.Generator:
    digest = hashlib.blake2b(f"{stream} {seed}".encode(), digest_size=7).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little"))
