"""The reports of all steps, packed as bytes for checkpoints; full blocks are packed only once."""

import json
from typing import Any

import torch
from torch import Tensor

from ..mapping import StepReport

BLOCK = 256
"""Number of steps that are packed together."""


class StepLog:
    """Packs a list of reports that grows at its end."""

    def __init__(self):
        self.blocks: list[Tensor] = []
        """Full blocks; these tensors never change."""

    def state_dict(self, steps: list[StepReport]) -> dict[str, Any]:
        """All reports as tensors of bytes."""
        while len(steps) >= BLOCK * (len(self.blocks) + 1):
            at = BLOCK * len(self.blocks)
            self.blocks.append(_packed(steps[at : at + BLOCK]))
        return {"blocks": list(self.blocks), "rest": _packed(steps[BLOCK * len(self.blocks) :])}

    def load_state_dict(self, state: dict[str, Any]) -> list[StepReport]:
        """The reports that ``state_dict`` packed."""
        self.blocks = list(state["blocks"])
        return [step for block in (*self.blocks, state["rest"]) for step in _unpacked(block)]


def _packed(steps: list[StepReport]) -> Tensor:
    return torch.frombuffer(bytearray(json.dumps([vars(step) for step in steps]).encode()), dtype=torch.uint8)


def _unpacked(block: Tensor) -> list[StepReport]:
    rows = json.loads(block.cpu().numpy().tobytes())
    return [StepReport(**{**row, "losses": tuple(row["losses"])}) for row in rows]
