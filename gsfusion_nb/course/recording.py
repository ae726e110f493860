"""Exercises of chapter 11: the unit of depth from two frames, the delay of the poses, bad poses
against bad points."""

import torch
from torch import Tensor

from ..geometry import se3
from .exercise import Attempt, Wrong, exercise


def _depth_factor(a: Tensor, b: Tensor, R: Tensor, t: Tensor) -> Tensor:
    shift = b - a @ R.T
    return (t @ t) / (shift.mean(0) @ t)


def _units_per_metre(a: Tensor, b: Tensor, R: Tensor, t: Tensor) -> Tensor:
    return ((b - a @ R.T).mean(0) @ t) / (t @ t)


def _turn_ignored(a: Tensor, b: Tensor, R: Tensor, t: Tensor) -> Tensor:
    return (t @ t) / ((b - a).mean(0) @ t)


def _lengths(a: Tensor, b: Tensor, R: Tensor, t: Tensor) -> Tensor:
    return t.norm() / (b - a @ R.T).norm(dim=1).mean()


@exercise(
    chapter=11,
    difficulty=3,
    minutes=12,
    solution=_depth_factor,
    hints=(
        "In metres the same point is s a in the first camera and s b in the second: R (s a) + t = "
        "s b.",
        "So s (b - R a) = t for every point: the turn is taken out, what is left is the motion in "
        "stored units.",
        "The points are noisy and t is not, so average the noisy side: the mean of b - R a is t / "
        "s. What counts of it is the part along t.",
    ),
    wrong=(
        Wrong(_units_per_metre, says="metres for one stored unit"),
        Wrong(_turn_ignored, says="the turn of the camera is taken out"),
        Wrong(_lengths, says="noise does not make it smaller"),
    ),
)
def depth_factor(attempt: Attempt) -> None:
    """What a stored unit of depth is in metres, from two frames with poses."""
    generator = torch.Generator().manual_seed(11)
    aside = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    a_m = (
        torch.rand(40, 3, generator=generator, dtype=torch.float64)
        + torch.tensor([-0.5, -0.5, 2.0]).double()
    )
    eye = torch.eye(3, dtype=torch.float64)
    attempt.on("depth in millimetres, the points 20 cm to the right in the second camera")
    got = attempt(1000 * a_m, 1000 * (a_m + aside), eye, aside)
    attempt.close(
        got, 0.001, "metres for one stored unit", tolerance=1e-6, why="a millimetre is 0.001 m"
    )
    R = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.05, 0.3, -0.1], dtype=torch.float64))[:3, :3]
    t = torch.tensor([0.1, -0.05, 0.2], dtype=torch.float64)
    got = attempt.on("a camera that also turns, depth too small by 5")(
        a_m / 5, (a_m @ R.T + t) / 5, R, t
    )
    attempt.close(
        got,
        5.0,
        "the turn of the camera is taken out",
        tolerance=1e-6,
        why="b is compared with R a",
    )
    many = (
        torch.rand(4000, 3, generator=generator, dtype=torch.float64)
        + torch.tensor([-0.5, -0.5, 2.0]).double()
    )
    noise = 0.1 * torch.randn(2, 4000, 3, generator=generator, dtype=torch.float64)
    got = attempt.on("4,000 points with a noise of 10 cm")(
        (many + noise[0]) / 5,
        (many @ R.T + t + noise[1]) / 5,
        R,
        t,
    )
    attempt.close(
        got,
        5.0,
        "noise does not make it smaller",
        tolerance=0.25,
        why="average b - R a before you divide",
    )


def _alike(x: Tensor, y: Tensor, k: int) -> float:
    n = len(x)
    pair = torch.stack([x[max(0, -k) : n - max(0, k)], y[max(0, k) : n - max(0, -k)]])
    return float(torch.corrcoef(pair)[0, 1])


def _pose_shift(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    return max(
        range(-reach, reach + 1),
        key=lambda k: _alike(image_motion, pose_motion, k),
    )


def _other_sign(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    return -_pose_shift(image_motion, pose_motion, reach)


def _least_difference(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    def difference(k: int) -> float:
        n = len(image_motion)
        x = image_motion[max(0, -k) : n - max(0, k)]
        y = pose_motion[max(0, k) : n - max(0, -k)]
        return float((x - y).square().mean())

    return min(range(-reach, reach + 1), key=difference)


def _sum_of_products(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    def products(k: int) -> float:
        n = len(image_motion)
        return float(
            (
                image_motion[max(0, -k) : n - max(0, k)] * pose_motion[max(0, k) : n - max(0, -k)]
            ).sum()
        )

    return max(range(-reach, reach + 1), key=products)


def _rolled(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    x = image_motion - image_motion.mean()
    return max(
        range(-reach, reach + 1),
        key=lambda k: float((x * (pose_motion - pose_motion.mean()).roll(-k)).sum()),
    )


def _only_forwards(image_motion: Tensor, pose_motion: Tensor, reach: int) -> int:
    return max(range(reach + 1), key=lambda k: _alike(image_motion, pose_motion, k))


@exercise(
    chapter=11,
    difficulty=3,
    minutes=15,
    solution=_pose_shift,
    hints=(
        "Try every k from -reach to reach. Image i belongs to pose i + k, so for k > 0 compare "
        "image_motion[: n - k] with pose_motion[k:].",
        "Pixels and radians cannot be subtracted. Compare the shapes of the curves: subtract the "
        "mean of each part, multiply, sum, and divide by both lengths (the correlation).",
        "Cut both curves to the part in which they overlap: roll() would bring the end to the "
        "beginning.",
    ),
    wrong=(
        Wrong(_other_sign, says="image i belongs to pose i + k"),
        Wrong(_only_forwards, says="the poses may be early, too"),
        Wrong(_least_difference, says="pixels and radians are different units"),
        Wrong(_sum_of_products, says="a longer overlap is not more alike"),
        Wrong(_rolled, says="the end does not follow the beginning"),
    ),
)
def pose_shift(attempt: Attempt) -> None:
    """By how many frames the poses are late, from how fast the images and the poses move."""

    def ask(
        case: str,
        image_motion: Tensor,
        pose_motion: Tensor,
        k: int,
        prop: str,
        reach: int = 3,
    ) -> None:
        got = attempt.on(case)(image_motion, pose_motion, reach)
        attempt.holds(
            isinstance(got, (int, float, Tensor)), "it returns a number", detail=f"got {got!r}"
        )
        attempt.holds(float(got) == k, prop, detail=f"got {float(got):g}, expected {k}")

    generator = torch.Generator().manual_seed(5)
    curve = torch.rand(46, generator=generator, dtype=torch.float64)
    early = curve[3:43]
    ask("the same curve twice", early, early.clone(), 0, "where nothing is shifted the answer is 0")
    ask("poses two frames late", early, curve[1:41], 2, "image i belongs to pose i + k")
    ask("poses three frames early", early, curve[6:46], -3, "the poses may be early, too")
    ask(
        "poses three frames late",
        early,
        curve[0:40],
        3,
        "a shift of reach frames is found, to both sides",
    )
    case = "poses five frames late, reach 6"
    ask(
        case,
        curve[6:46],
        curve[1:41],
        5,
        "shifts of up to reach frames are tried",
        reach=6,
    )
    case = "images in pixels, poses in radians, poses two frames late"
    ask(case, 30 * early + 2, 0.1 * curve[1:41], 2, "pixels and radians are different units")
    case = "a camera that never stops, poses two frames late"
    ask(case, early + 3, curve[1:41] + 3, 2, "a longer overlap is not more alike")
    slow_curve = 0.1 * curve[:14]
    slow_curve[-3:] = torch.tensor([5.0, 9.0, 4.0], dtype=torch.float64)
    case = (
        "twelve frames with a jerk at the end, which the poses, two frames late, have not seen yet"
    )
    ask(case, slow_curve[2:14], slow_curve[0:12], 2, "the end does not follow the beginning")
    rising = curve + torch.linspace(0, 4, 46, dtype=torch.float64).square()
    case = "motion that grows towards the end, poses one frame late"
    ask(case, rising[3:43], rising[2:42], 1, "a part with more motion is not more alike")


def _tell_apart(a: Tensor, b: Tensor, T_ba: Tensor, noise_m: float) -> str:
    def rms_m(R: Tensor, t: Tensor) -> float:
        return float((a @ R.T + t - b).square().sum(1).mean().sqrt())

    if rms_m(T_ba[:3, :3], T_ba[:3, 3]) < 3 * noise_m:
        return "fits"
    from_mean_a = a - a.mean(0)
    from_mean_b = b - b.mean(0)
    U, _, Vt = torch.linalg.svd(from_mean_a.T @ from_mean_b)
    no_mirror = torch.ones(3).to(a)
    no_mirror[2] = torch.sign(torch.linalg.det(Vt.T @ U.T))
    R = Vt.T @ torch.diag(no_mirror) @ U.T
    return "poses" if rms_m(R, b.mean(0) - R @ a.mean(0)) < 3 * noise_m else "points"


def _always_poses(a: Tensor, b: Tensor, T_ba: Tensor, noise_m: float) -> str:
    rms = (a @ T_ba[:3, :3].T + T_ba[:3, 3] - b).square().sum(1).mean().sqrt()
    return "fits" if rms < 3 * noise_m else "poses"


def _no_turn(a: Tensor, b: Tensor, T_ba: Tensor, noise_m: float) -> str:
    first = _always_poses(a, b, T_ba, noise_m)
    rotated = a @ T_ba[:3, :3].T
    rmse = (rotated - rotated.mean(0) - b + b.mean(0)).square().sum(1).mean().sqrt()
    return first if first == "fits" or rmse < 3 * noise_m else "points"


def _with_mirrors(a: Tensor, b: Tensor, T_ba: Tensor, noise_m: float) -> str:
    U, _, Vt = torch.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = Vt.T @ U.T
    rmse = ((a - a.mean(0)) @ R.T - b + b.mean(0)).square().sum(1).mean().sqrt()
    first = _always_poses(a, b, T_ba, noise_m)
    return first if first == "fits" or rmse < 3 * noise_m else "points"


def _no_noise(a: Tensor, b: Tensor, T_ba: Tensor, noise_m: float) -> str:
    return "fits" if torch.allclose(se3.apply(T_ba, a), b, atol=1e-6) else "points"


@exercise(
    chapter=11,
    difficulty=4,
    minutes=20,
    solution=_tell_apart,
    hints=(
        "First the given pose: the root of the mean squared distance between R a + t and b. Below "
        "3 noise_m it fits.",
        "Otherwise look for the rigid motion that fits best. Its R comes from the singular values "
        "of (a - mean a)^T "
        "(b - mean b) = U S V^T: R = V U^T (Kabsch 1976). Then t = mean b - R mean a.",
        "If that fits, only the pose was wrong. If even the best motion does not, the points are "
        "wrong: focal length, principal point, kind of depth. Where det(V U^T) is -1, turn the "
        "sign of the last column of V: a mirror is no motion.",
    ),
    wrong=(
        Wrong(_always_poses, says="no motion repairs a wrong focal length"),
        Wrong(_no_turn, says="the best motion may also turn"),
        Wrong(_with_mirrors, says="a mirror image is no motion"),
        Wrong(_no_noise, says="noise is not a mistake"),
    ),
)
def tell_apart(attempt: Attempt) -> None:
    """Are the poses wrong, or the points themselves?"""
    generator = torch.Generator().manual_seed(7)
    a = (
        torch.rand(300, 3, generator=generator, dtype=torch.float64)
        * torch.tensor([3.0, 2.0, 2.0]).double()
    )
    a = a + torch.tensor([-1.5, -1.0, 1.0]).double()
    true = se3.exp(torch.tensor([0.3, -0.1, 0.2, 0.1, 0.5, 0.0], dtype=torch.float64))
    noise = 0.005 * torch.randn(2, 300, 3, generator=generator, dtype=torch.float64)
    b = se3.apply(true, a)
    # x and y of points lifted with fx, fy too small
    wide = torch.tensor([1.2, 1.2, 1.0], dtype=torch.float64)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    aside = true.clone()
    aside[0, 3] += 0.1
    T_rotated = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.1, 0.0], dtype=torch.float64)) @ true
    cases = (
        ("the true pose, noise of 5 mm", a, b, true, "fits", "noise is not a mistake"),
        (
            "a pose 10 cm beside the true one",
            a,
            b,
            aside,
            "poses",
            "a shifted pose is the pose's mistake",
        ),
        ("a pose turned by 6 degrees", a, b, T_rotated, "poses", "the best motion may also turn"),
        (
            "both frames with a focal length 17 % too short",
            wide * a,
            wide * b,
            true,
            "points",
            "no motion repairs a wrong focal length",
        ),
        ("the second image mirrored", a, mirror * b, true, "points", "a mirror image is no motion"),
    )
    for case, first, second, T_ba, reference, prop in cases:
        got = attempt.on(case)(
            first + noise[0],
            second + noise[1],
            T_ba,
            0.005,
        )
        attempt.holds(
            got in ("fits", "poses", "points"),
            "it returns one of the three words",
            detail=f"got {got!r}",
        )
        attempt.holds(got == reference, prop, detail=f"got {got!r}, expected {reference!r}")
    attempt.on("noise of 5 cm, and a pose 1 m beside the true one")
    aside[0, 3] += 0.9
    got = attempt(
        a + 10 * noise[0],
        b + 10 * noise[1],
        aside,
        0.05,
    )
    prop = "what counts as small is a multiple of noise_m, for the given pose and for the best one"
    attempt.holds(got == "poses", prop, detail=f"got {got!r}, expected 'poses'")
