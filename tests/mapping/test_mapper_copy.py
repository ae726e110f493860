"""Mappers that are pickled and copied."""

import copy
import pickle

import pytest
from small_configs import CONFIGS

from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.optim import ViewLoss

COPIES = {
    "pickle": lambda mapper: pickle.loads(pickle.dumps(mapper)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


def grey(rendered, view):
    """Half the sum of squared differences."""
    gap = rendered.rgb - view.rgb
    return ViewLoss(value=gap.square().sum() / 2, v_rgb=gap)


@pytest.mark.parametrize("name", CONFIGS)
def test_a_copy_goes_on_to_the_same_bits(name, same):
    config = CONFIGS[name]
    frames = list(open_sequence("room", n_frames=240, data=config.data).mapping)
    half = len(frames) // 2
    mapper = make_mapper(config)
    for frame in frames[:half]:
        mapper.step(frame)
    mapper.notes.append("a note")
    start = mapper.state_dict()
    copies = {how: make(mapper) for how, make in COPIES.items()}
    for frame in frames[half:]:
        mapper.step(frame)
    for _ in mapper.global_optimise(1):
        pass
    end = mapper.state_dict()
    assert len(mapper.gaussians) > 20
    for how, other in copies.items():
        assert type(other) is type(mapper)
        assert other.config == config
        assert other.notes == ["a note"]
        same(other.state_dict(), start, how)
        for frame in frames[half:]:
            other.step(frame)
        for _ in other.global_optimise(1):
            pass
        same(other.state_dict(), end, how)


def test_a_copy_has_the_functions_of_its_mapper():
    mapper = make_mapper(CONFIGS["gsfusion"], loss=grey, seeding="cone_gs")
    for make in COPIES.values():
        other = make(mapper)
        assert other.training.loss is grey
        assert other.rule is mapper.rule
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(make_mapper(CONFIGS["gsfusion"], loss=lambda *given: grey(*given)))


def test_half_a_frame_stays_half_a_frame_and_a_busy_mapper_is_not_copied():
    mapper = make_mapper(CONFIGS["gsfusion"])
    mapper.guard.half_mapped = "frame 3 was only half mapped"
    assert copy.deepcopy(mapper).guard.half_mapped == "frame 3 was only half mapped"
    mapper.guard.half_mapped = ""
    with (
        mapper.guard.while_mapping(4),
        pytest.raises(RuntimeError, match="frame 4 is being mapped; wait"),
    ):
        copy.deepcopy(mapper)
