"""What a mapper saves, so that a run can go on later from exactly the same state."""

from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from ..checks import check_whole
from ..config import SystemConfig, from_dict, to_dict
from ..errors import shown
from ..gaussians import GaussianModel
from ..optim import KeyframeList, UpdateFunction
from ..seeding import SeedingRule, rule_name
from ..seeding.rule_file import find_rule
from .after_steps import AfterSteps
from .keyframe_passes import KeyframePasses
from .localiser import Localiser
from .random_streams import RandomStreams
from .rule_in_use import RuleInUse, check_known
from .rule_settings import settings_of_run
from .training import LossFunction, Training, given_functions

M = TypeVar("M", bound="SavesState")


class SavesState:
    """The part of every mapper that saves its state and restores it.

    ``Mapper`` sets the attributes.
    """

    config_type: ClassVar[type[SystemConfig]]
    model_type: ClassVar[type[GaussianModel]]
    config: Any
    gaussians: Any
    device: torch.device
    rule: SeedingRule
    rule_in_use: RuleInUse
    training: Training
    after_steps: AfterSteps
    keyframes: KeyframeList
    random: RandomStreams
    localiser: Localiser
    passes: KeyframePasses
    n_frames: int
    notes: list[str]

    def constant_tensors(self) -> list[Tensor]:
        """Tensors in ``state_dict`` that never change: a checkpoint writes them once."""
        images = [image for k in self.keyframes for image in (k.rgb_u8, k.depth_m)]
        return [image for image in images if image is not None]

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue later from exactly this state, as tensors and plain values."""
        return {
            "config": to_dict(self.config),
            "rule": self.rule_in_use.state_dict(),
            "training": self.training.state_dict(),
            "n_frames": self.n_frames,
            "steps_taken": self.after_steps.taken,
            "passes": self.passes.state_dict(),
            "localiser": self.localiser.state_dict(),
            "random": self.random.state_dict(),
            "gaussians": self.gaussians.state_dict(),
            "keyframes": self.keyframes.state_dict(),
        }

    @classmethod
    def from_state_dict(
        cls: type[M],
        state: dict[str, Any],
        *,
        seeding: "str | SeedingRule | None" = None,
        device: torch.device | str = "cpu",
        loss: LossFunction | None = None,
        optimiser: UpdateFunction | None = None,
    ) -> M:
        """The mapper that was saved with ``state_dict``; a rule that is not registered by name must be given again, and
        so must a loss and an optimiser.

        Raises:
            SequenceError: the rule is neither given nor registered by its name, the loss or optimiser is not given, or
                one of them had a state that was not saved.
        """
        config = from_dict(cls.config_type, state["config"])
        if seeding is None:
            check_known(state["rule"])
        rule = find_rule(seeding if seeding is not None else state["rule"]["name"])
        settings = settings_of_run(config, rule, cls)
        given = given_functions(loss, optimiser)
        mapper = cls(settings, seeding=rule, device=device, **given)  # pyright: ignore[reportCallIssue]
        mapper.notes += mapper.training.notes_on(state.get("training", {}))
        mapper.rule_in_use.load_state_dict(state["rule"])
        if mapper.rule_in_use.differs(state["rule"]):
            mapper.notes.append(
                f"after {state['n_frames']} frames the run continued with another seeding rule, or an edited one: "
                f"{shown(rule_name(mapper.rule))} instead of {shown(state['rule']['name'])}"
            )
        mapper._load(state)
        return mapper

    def _load(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved; a subclass extends both.

        Raises:
            ValueError: The state contradicts itself or the settings.
        """
        self.localiser.load_state_dict(state["localiser"])
        check_whole("n_frames", state["n_frames"], 0)
        self.n_frames = state["n_frames"]
        check_whole("steps_taken", state["steps_taken"], 0)
        self.after_steps.taken = state["steps_taken"]
        if len(self.localiser.poses) != self.n_frames:
            raise ValueError(f"{self.n_frames} frames must have as many poses, got {len(self.localiser.poses)}")
        self.random.load_state_dict(state["random"])
        self.gaussians = self.model_type.from_state_dict(state["gaussians"], self.device)
        if self.gaussians.sh_degree != self.config.sh_degree:
            raise ValueError(f"sh_degree must be {self.config.sh_degree}, got {self.gaussians.sh_degree}")
        self.keyframes = KeyframeList.from_state_dict(state["keyframes"], self.keyframes.device)
        self.passes.load_state_dict(state["passes"], len(self.keyframes))
        if lost := self.gaussians.count_not_finite():
            self.notes.append(f"{lost} Gaussians of the checkpoint hold NaN or infinities; they are not drawn")
