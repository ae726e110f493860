"""What ``pickle`` and ``copy`` make of a mapper: its state, and the functions that it was given."""

from typing import Any

from .training import given_functions


def parts_of_copy(mapper: Any) -> tuple[Any, ...]:
    """What ``__reduce__`` of a mapper returns.

    Raises:
        RuntimeError: a frame is being mapped.
        SequenceError: the rule stored something that is not in its memory.
    """
    mapper.guard.check_idle("copying its mapper")
    given = {"seeding": mapper.rule, "device": mapper.device}
    given |= given_functions(mapper.training.loss, mapper.training.optimiser)
    beside = {"notes": list(mapper.notes), "half_mapped": mapper.guard.half_mapped}
    return copied_mapper, (type(mapper), mapper.state_dict(), given, beside)


def copied_mapper(
    system: Any, state: dict[str, Any], given: dict[str, Any], beside: dict[str, Any]
) -> Any:
    """The mapper of which ``parts_of_copy`` gave the parts.

    Args:
        system: Its class.
        state: Its ``state_dict``.
        given: Arguments of ``from_state_dict``.
        beside: What belongs to a mapper and not to its checkpoint: the notes, and which frame was
            only half mapped.
    """
    mapper = system.from_state_dict(state, **given)
    news = [note for note in mapper.notes if note not in beside["notes"]]
    mapper.notes = [*beside["notes"], *news]
    mapper.guard.half_mapped = beside["half_mapped"]
    return mapper
