"""Exercises of chapter 6: the online loop of GSFusion: the steps of a frame, keyframes, and correct
frame rates."""

import torch
from torch import Tensor

from ..config import gsfusion, replace
from ..mapping import GSFusion
from ..tsdf import integrate
from ..types import Frame
from .exercise import Attempt, Becomes, Failed, Wrong, Yours, exercise
from .stand_ins import Log as Log
from .stand_ins import chequered_wall


def _frame_rate(seconds: list[float]) -> float:
    return len(seconds) / sum(seconds)


def _mean_of_rates(seconds: list[float]) -> float:
    return sum(1 / s for s in seconds) / len(seconds)


@exercise(
    chapter=6,
    difficulty=1,
    minutes=4,
    solution=_frame_rate,
    hints=(
        "Three frames in 0.7 s: how many frames is that in one second?",
        "Frames divided by time. Do not average rates: quick frames would count more than the time "
        "they took.",
    ),
    wrong=(Wrong(_mean_of_rates, says="frames divided by the time they took"),),
)
def frame_rate(attempt: Attempt) -> None:
    """Frames per second of a run, from the seconds of each frame."""
    attempt.close(
        attempt.on("ten frames of 0.1 s")([0.1] * 10),
        10.0,
        "equal frames: one divided by the time of each",
    )
    attempt.on("one frame of 0.01 s and one of 0.99 s")
    why = "The mean of 1/t would be 50.5, but only two frames were mapped in that second"
    attempt.close(attempt([0.01, 0.99]), 2.0, "frames divided by the time they took", why=why)
    attempt.on("three frames of 0.1, 0.2 and 0.4 s")
    attempt.close(attempt([0.1, 0.2, 0.4]), 3 / 0.7, "frames divided by the time they took")


def _plan_frame(
    n_seeds: int, n_keyframes: int, m: int, n: int, r: int, min_seeds: int
) -> tuple[bool, int, int]:
    is_keyframe = n_seeds > min_seeds
    if is_keyframe:
        return True, m, 0
    return False, n, min(r, n_keyframes)


def _plan_with_at_least(n_seeds, n_keyframes, m, n, r, min_seeds):
    is_keyframe = n_seeds >= min_seeds
    return is_keyframe, m if is_keyframe else n, 0 if is_keyframe else min(r, n_keyframes)


def _plan_revisiting_always(n_seeds, n_keyframes, m, n, r, min_seeds):
    is_keyframe = n_seeds > min_seeds
    return is_keyframe, m if is_keyframe else n, min(r, n_keyframes)


def _plan_with_replacement(n_seeds, n_keyframes, m, n, r, min_seeds):
    is_keyframe = n_seeds > min_seeds
    return is_keyframe, m if is_keyframe else n, 0 if is_keyframe else r


def _as_plan_frame(yours: Yours, *numbers: int) -> tuple[bool, int, int]:
    """Yours with the mapper's settings."""
    plan = yours(*numbers)
    if not isinstance(plan, (tuple, list)) or len(plan) != 3 or any(int(k) < 0 for k in plan):
        yours.fail(f"must return is_keyframe, steps, revisits; it returned {plan!r}", numbers)
    return bool(plan[0]), int(plan[1]), int(plan[2])


@exercise(
    chapter=6,
    difficulty=2,
    minutes=8,
    solution=_plan_frame,
    becomes=Becomes("plan_frame", _as_plan_frame),
    hints=(
        "Keyframe or not is decided by the number of new Gaussians alone: 'greater than a certain "
        "threshold'.",
        "A keyframe gets m steps and no others. Any other frame gets n, and then r on random "
        "keyframes.",
        "How many different keyframes can you draw from a list of one?",
    ),
    wrong=(
        Wrong(_plan_with_at_least, says="more new Gaussians than"),
        Wrong(_plan_revisiting_always, says="at a keyframe no other frames are revisited"),
        Wrong(_plan_with_replacement, says="never more revisits than keyframes"),
    ),
)
def plan_frame(attempt: Attempt) -> None:
    """How many optimisation steps a frame gets (III-B.3)."""
    names = ("is_keyframe", "steps", "revisits")

    def plan(case: str, *numbers: int) -> tuple:
        return attempt.unpack(attempt.on(case)(*numbers), names)

    case = "300 new Gaussians, 7 keyframes so far, m = 5, n = 3, r = 2, threshold 50"
    key, steps, revisits = plan(case, 300, 7, 5, 3, 2, 50)
    attempt.holds(
        key, "a frame with many new Gaussians is a keyframe", detail=f"is_keyframe is {key!r}"
    )
    attempt.close(steps, 5, "a keyframe gets m steps")
    attempt.close(revisits, 0, "at a keyframe no other frames are revisited")
    key, steps, revisits = plan("10 new Gaussians, 7 keyframes so far", 10, 7, 5, 3, 2, 50)
    attempt.holds(
        not key,
        "a frame with few new Gaussians is not a keyframe",
        detail=f"is_keyframe is {key!r}",
    )
    attempt.close([steps, revisits], [3, 2], "any other frame gets n steps, and r revisits")
    key, *_ = plan("exactly 50 new Gaussians", 50, 7, 5, 3, 2, 50)
    attempt.holds(
        not key,
        "a keyframe adds more new Gaussians than the threshold",
        detail="50 is not more than 50",
    )
    key, steps, revisits = plan(
        "120 new Gaussians, threshold 200, m = 6, n = 2, r = 1", 120, 7, 6, 2, 1, 200
    )
    prop = "the threshold is min_seeds, and the steps are m, n and r, not the paper's numbers"
    attempt.holds(
        (bool(key), steps, revisits) == (False, 2, 1),
        prop,
        detail=f"got {key!r}, {steps}, {revisits}",
    )
    case = "10 new Gaussians, one keyframe so far"
    attempt.close(
        plan(case, 10, 1, 5, 3, 2, 50)[2],
        1,
        "there are never more revisits than keyframes: each goes to another one",
    )
    case = "10 new Gaussians, no keyframe yet"
    attempt.close(
        plan(case, 10, 0, 5, 3, 2, 50)[2],
        0,
        "without keyframes there are no revisits",
    )


def _draw_keyframes(n_keyframes: int, count: int, generator: torch.Generator) -> Tensor:
    return torch.randperm(n_keyframes, generator=generator)[:count]


def _draw_with_replacement(n_keyframes: int, count: int, generator: torch.Generator) -> Tensor:
    return torch.randint(
        0,
        max(n_keyframes, 1),
        (min(count, n_keyframes),),
        generator=generator,
    )


def _draw_the_latest(n_keyframes: int, count: int, generator: torch.Generator) -> Tensor:
    return torch.arange(n_keyframes).flip(0)[:count]


def _draw_from_the_global_generator(
    n_keyframes: int, count: int, generator: torch.Generator
) -> Tensor:
    return torch.randperm(n_keyframes)[:count]


def _as_draw_keyframes(
    yours: Yours, n_keyframes: int, count: int, generator: torch.Generator
) -> Tensor:
    """Yours, with the mapper's generator. Another way to shuffle draws other keyframes than the
    reference."""
    inputs = (n_keyframes, count, generator)
    draws = torch.as_tensor(yours(*inputs)).long().reshape(-1)
    right = len(draws) == min(count, n_keyframes) == len(draws.unique())
    if not right or (len(draws) and not 0 <= int(draws.min()) <= int(draws.max()) < n_keyframes):
        yours.fail(
            f"must return {min(count, n_keyframes)} different numbers; it returned "
            f"{draws.tolist()}",
            inputs,
        )
    return draws


@exercise(
    chapter=6,
    difficulty=2,
    minutes=6,
    solution=_draw_keyframes,
    becomes=Becomes("draw_keyframes", _as_draw_keyframes),
    hints=(
        "The paper: 'the first (m-n) keyframes after shuffling'. Which torch function shuffles "
        "0..n-1?",
        "torch.randperm takes the generator; a slice also works for lists that are too short.",
    ),
    wrong=(
        Wrong(_draw_with_replacement, says="no keyframe twice"),
        Wrong(_draw_the_latest, says="every keyframe has the same chance"),
        Wrong(_draw_from_the_global_generator, says="the generator that is passed in"),
    ),
)
def draw_keyframes(attempt: Attempt) -> None:
    """Indices of random keyframes to revisit."""

    def draw(
        case: str,
        n: int,
        count: int,
        seeds: int = 1,
    ) -> list[list[int]]:
        samples = [
            attempt.on(case)(n, count, torch.Generator().manual_seed(seed)) for seed in range(seeds)
        ]
        return [[int(i) for i in torch.as_tensor(each).reshape(-1).tolist()] for each in samples]

    case = "2 out of 5, drawn 200 times"
    draws = draw(case, 5, 2, 200)
    attempt.holds(
        all(len(d) == 2 and min(d) >= 0 and max(d) < 5 for d in draws),
        "as many indices as requested, in 0..n-1",
        detail=f"one draw was {next((d for d in draws if len(d) != 2 or max(d) > 4), draws[0])}",
    )
    attempt.holds(
        all(len(set(d)) == 2 for d in draws),
        "no keyframe twice in one draw",
        detail=f"one draw was {next((d for d in draws if len(set(d)) < 2), [])}",
    )
    torch_state = torch.get_rng_state()
    second = draw(case, 5, 2, 20)
    same = torch.equal(torch_state, torch.get_rng_state()) and second == draws[:20]
    attempt.holds(
        same,
        "random numbers come only from the generator that is passed in",
        detail="the same seed gave another draw, or torch's global generator has moved",
    )
    share = torch.bincount(torch.tensor(draws).flatten(), minlength=5) / 400
    attempt.holds(
        (share - 0.2).abs().max() < 0.07,
        "every keyframe has the same chance",
        detail=f"shares of the five: {[round(float(s), 2) for s in share]}, expected 0.2 each",
    )
    attempt.close(
        sorted(draw("4 out of 3", 3, 4)[0]),
        [0, 1, 2],
        "from a short list, all of it",
    )
    attempt.close(len(draw("2 out of none", 0, 2)[0]), 0, "from an empty list, nothing")


def _map_frame(mapper: GSFusion, frame: Frame, optimise) -> int:
    integrate(mapper.volume, frame)
    seeds = mapper.propose_seeds(mapper.seed_context(frame))
    mapper.gaussians.append(seeds, frame.index)
    is_keyframe = len(seeds) > mapper.config.keyframe_min_seeds
    if is_keyframe:
        mapper.keyframes.append(frame)
    optim = mapper.config.optim
    for _ in range(optim.keyframe_iterations if is_keyframe else optim.frame_iterations):
        optimise(frame)
    if not is_keyframe:
        for keyframe in mapper.keyframes.draw(
            optim.random_keyframe_iterations, mapper.random.keyframes
        ):
            optimise(keyframe)
    return len(seeds)


def _map_seeding_first(mapper: GSFusion, frame: Frame, optimise) -> int:
    seeds = mapper.propose_seeds(mapper.seed_context(frame))
    integrate(mapper.volume, frame)
    mapper.gaussians.append(seeds, frame.index)
    return len(seeds)


def _map_optimising_too_early(mapper: GSFusion, frame: Frame, optimise) -> int:
    integrate(mapper.volume, frame)
    for _ in range(mapper.config.optim.keyframe_iterations):
        optimise(frame)
    seeds = mapper.propose_seeds(mapper.seed_context(frame))
    mapper.gaussians.append(seeds, frame.index)
    return len(seeds)


def _map_without_keyframes(mapper: GSFusion, frame: Frame, optimise) -> int:
    mapper.config = replace(mapper.config, keyframe_min_seeds=1_000_000)
    return _map_frame(mapper, frame, optimise)


def _map_forgetting(mapper: GSFusion, frame: Frame, optimise) -> int:
    mapper.config = replace(mapper.config, optim__random_keyframe_iterations=0)
    return _map_frame(mapper, frame, optimise)


@exercise(
    chapter=6,
    difficulty=4,
    minutes=20,
    solution=_map_frame,
    hints=(
        "Four parts in this order: integrate(mapper.volume, frame); seeds = mapper.propose_seeds("
        "mapper.seed_context(frame)); mapper.gaussians.append(seeds, frame.index); "
        "optimise(frame).",
        "A frame with more than mapper.config.keyframe_min_seeds seeds goes to "
        "mapper.keyframes.append(frame) and gets "
        "mapper.config.optim.keyframe_iterations steps; others frame_iterations.",
        "After a frame that is not a keyframe: for keyframe in mapper.keyframes.draw("
        "mapper.config.optim.random_keyframe_iterations, mapper.random.keyframes): "
        "optimise(keyframe).",
    ),
    wrong=(
        Wrong(_map_seeding_first, says="the frame is fused into the TSDF before the rule runs"),
        Wrong(
            _map_optimising_too_early,
            says="new Gaussians are in the map when the frame is optimised",
        ),
        Wrong(_map_without_keyframes, says="becomes a keyframe"),
        Wrong(_map_forgetting, says="random keyframes"),
    ),
)
def map_frame(attempt: Attempt) -> None:
    """The whole step: fuse, seed, optimise, revisit (Fig. 2)."""
    theirs = _small_mapper()
    ours = _small_mapper()
    log = Log(theirs)
    first = chequered_wall(0)
    reference = _map_frame(ours, first, lambda view: None)
    got = attempt.on("a first frame of a patterned wall")(theirs, first, log)
    attempt.holds(
        theirs.volume.n_blocks > 0,
        "the frame is fused into the TSDF",
        detail="the volume is still empty",
    )
    attempt.close(
        len(theirs.gaussians),
        reference,
        "the frame is fused into the TSDF before the rule runs, and the seeds are appended to the "
        "map",
        why="Before, every voxel has weight 0",
    )
    attempt.close(got, reference, "it returns the number of new Gaussians")
    early = any(n < reference for _, _, n in log.calls)
    attempt.holds(
        not early,
        "the new Gaussians are in the map when the frame is optimised",
        detail="optimise was called while the map was empty",
    )
    attempt.holds(
        len(theirs.keyframes) == 1,
        "a frame with many new Gaussians becomes a keyframe",
        detail=f"{reference} new Gaussians, and {len(theirs.keyframes)} keyframes",
    )
    attempt.close(len(log.calls), 5, "a keyframe gets m = 5 steps, all on itself")
    _second(attempt, theirs, log, "the same wall again")


def _second(attempt: Attempt, mapper: GSFusion, log: Log, case: str) -> None:
    """The frame shows nothing new: three steps on it, then one on the only keyframe."""
    log.calls.clear()
    attempt.close(
        attempt.on(case)(mapper, chequered_wall(1), log),
        0,
        "what was seen is not seeded again",
    )
    attempt.close(len(mapper.keyframes), 1, "a frame with few new Gaussians is not a keyframe")
    kinds = [kind for kind, _, _ in log.calls]
    attempt.close(kinds.count("frame"), 3, "a frame that is not a keyframe gets n = 3 steps")
    attempt.holds(
        kinds.count("keyframe") == 1,
        "afterwards random keyframes are revisited, up to two",
        detail=f"the list has one, and {kinds.count('keyframe')} were optimised",
    )
    if kinds[-1] != "keyframe":
        raise Failed("the revisits come last", case, f"the order was {', '.join(kinds)}")


def _small_mapper() -> GSFusion:
    small = {"sh_degree": 0, "tsdf__voxel_size_m": 0.05, "seeding__quadtree_contrast": "std"}
    config = gsfusion("online", "paper_steps", **small)
    return GSFusion(config)
