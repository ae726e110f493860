"""Every operation with operands that it must not take; a program of its own, because a mistake may
end the process.

    python -P bad_operands.py BACKEND...

prints, as JSON, what each case gave for each backend: the sentence of its ``ValueError``, numbers,
or what else happened.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

import torch
from kernel_cases import make_frame, make_params
from torch import Tensor

from gsfusion_nb.backends import Record, chosen, offered, use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.optim import (
    ColumnRates,
    adam_update,
    adam_update_map,
    dssim_vjp,
    expected_depth_loss,
    l1_mse_vjp,
    l2_mse_vjp,
    rgbd_l1_vjp,
)
from gsfusion_nb.render import (
    Base,
    disc_depth,
    disc_depth_vjp,
    footprints,
    render_forward,
    render_over_base,
    render_over_base_vjp,
    render_vjp,
)
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.seeding.points import k_nearest
from gsfusion_nb.tracking import brightness_system, icp_system, picture_of
from gsfusion_nb.tracking.surface import Surface, depth_pyramid
from gsfusion_nb.tsdf import (
    TsdfVolume,
    band_blocks,
    extract_mesh,
    fuse_frame_,
    integrate,
    new_band_blocks,
    raycast,
    sample_fused_voxels,
    sample_voxels,
)
from gsfusion_nb.types import Camera, GaussianParams

CENTRES = ("v_uv", "v_uv_abs")
"""Operands of ``render_vjp`` that it fills, if they are given."""

SHAPES: dict[str, Callable[[Tensor], Any]] = {
    "one row short": lambda x: x[:-1],
    "one row long": lambda x: torch.cat([x, x[:1]]),
    "no rows": lambda x: x[:0],
    "one dimension more": lambda x: x[None],
    "transposed": lambda x: (
        x.transpose(0, -1) if x.ndim > 1 and x.shape[0] != x.shape[-1] else x[:-1]
    ),
    "half precision": lambda x: x.to(torch.float16),
    "complex": lambda x: x.to(torch.complex64),
    "on another device": lambda x: torch.empty_like(x, device="meta"),
    "a list": lambda x: x.tolist(),
    "nothing": lambda x: None,
    "with gaps": lambda x: torch.stack([x, x], dim=-1)[..., 0],
}

VALUES: dict[str, dict[str, Callable[[Tensor], Tensor]]] = {
    "T_WC": {"NaN": lambda T: T * torch.nan, "infinite": lambda T: T + torch.inf},
    "hit_index": {
        "a row too many": lambda x: x.clamp_min(50),
        "far too large": lambda x: torch.full_like(x, 2**40),
        "negative": lambda x: torch.full_like(x, -(2**40)),
    },
    "xyz_W": {
        "NaN": lambda x: x * torch.nan,
        "far away": lambda x: x * 1e30,
        "infinite": lambda x: x / 0,
    },
    "depth_m": {
        "NaN": lambda x: x * torch.nan,
        "infinite": lambda x: x / 0,
        "huge": lambda x: x * 1e30,
    },
    "log_scale": {"huge": lambda x: x + 1000},
    "rgb": {"NaN": lambda x: x * torch.nan},
}


def operations() -> dict[str, tuple[Callable, dict[str, Any]]]:
    """Operation -> function of named operands, and operands that it takes."""
    frame = make_frame()
    params = make_params(1, "cpu")
    camera = frame.camera
    T_WC = frame.T_WC
    size = (camera.height, camera.width)
    mask = torch.ones(size, dtype=torch.bool)
    rows = torch.ones(len(params), dtype=torch.bool)
    view = {"params": params, "camera": camera, "T_WC": T_WC}
    picture, saved = render_forward(**view, opaque_alpha=0.5)
    disc = view | {"hit_index": picture.hit_index}
    v = {"v_rgb": torch.ones(*size, 3), "v_depth_m": torch.ones(size), "v_alpha": torch.ones(size)}
    centres = {name: torch.zeros(len(params), 2) for name in CENTRES}
    base = Base(
        rgb=frame.rgb,
        depth_m=frame.depth_m + 0.5,
        weight=torch.ones(size),
    )
    with use_backend(chosen() if chosen() in offered("render_over_base") else "reference"):
        over = render_over_base(params, camera, T_WC, base, behind_m=0.1)[1]
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05))
    with use_backend("reference"):  # the same for all
        integrate(volume, frame)
        surface = raycast(volume, camera, T_WC)
        closer = dataclasses.replace(frame, depth_m=0.8 * frame.depth_m)
        missing = volume.reserve(volume.index.missing(band_blocks(volume, closer)))
    model = Surface(depth_m=surface.depth_m, normal_W=surface.normal_W, camera=camera, T_WC=T_WC)
    level = depth_pyramid(frame.depth_m, camera, (1,))[0]
    images = {
        "rgb": frame.rgb,
        "depth_m": frame.depth_m,
        "target_rgb": frame.rgb,
        "target_depth_m": frame.depth_m,
    }
    pair = {"rgb": frame.rgb, "target": 0.5 * frame.rgb}
    x = params.sh.flatten(1)
    moments = {"gradient": x, "exp_avg": x.clone(), "exp_avg_sq": x * x}
    adam = {
        "param": x.clone(),
        **moments,
        "steps": torch.ones(len(x), dtype=torch.int64),
        "lr": torch.ones(12),
    }
    gates = {"max_distance_m": 0.1, "min_cosine": 0.5}
    bright = {
        "brightness": frame.rgb.mean(-1),
        "picture": picture_of(model, frame.rgb, 1),
        "max_distance_m": 0.1,
    }
    decay = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8}
    squares = GaussianParams(**{name: column.square() for name, column in vars(params).items()})
    adam_map = {"params": params, "gradients": params, "exp_avg": params, "exp_avg_sq": squares}
    adam_map |= {"steps": adam["steps"], "rates": ColumnRates(*(0.1 * k for k in range(1, 7)))}

    def update(**operands: Any) -> list[Any]:
        values = {name: copied(value) for name, value in operands.items()}
        adam_update(**values, **decay)
        return [values["param"], values["exp_avg"]]

    def update_map(**operands: Any) -> list[Any]:
        values = {name: copied(value) for name, value in operands.items()}
        adam_update_map(**values, **decay)
        return [values["params"], values["exp_avg"]]

    return {
        "render_forward": (
            lambda **o: render_forward(**o)[0],
            view | {"pixels": mask, "opaque_alpha": 0.5},
        ),
        "render_vjp": (render_vjp, {"saved": saved, **v, "rows": rows, **centres}),
        "render_over_base": (
            lambda **o: render_over_base(**o, behind_m=0.1)[0],
            view | {"base": base},
        ),
        "render_over_base_vjp": (
            render_over_base_vjp,
            {"saved": over, "v_rgb": v["v_rgb"], "rows": rows, **centres},
        ),
        "footprints": (footprints, view),
        "disc_depth": (disc_depth, disc | {"min_cosine": 0.5, "max_offset": 1.0}),
        "disc_depth_vjp": (disc_depth_vjp, disc | {"v_depth_m": v["v_depth_m"], "rows": rows}),
        "adam_update": (update, adam),
        "adam_update_map": (update_map, adam_map),
        "l1_mse_vjp": (l1_mse_vjp, pair),
        "l2_mse_vjp": (l2_mse_vjp, pair),
        "dssim_vjp": (dssim_vjp, pair),
        "expected_depth_loss": (
            expected_depth_loss,
            {
                "depth_m": images["depth_m"],
                "alpha": v["v_alpha"],
                "target_m": images["target_depth_m"],
                "coverage": 0.1,
                "far_m": 2.0,
                "weight": 0.2,
            },
        ),
        "rgbd_l1_vjp": (rgbd_l1_vjp, images | {"pixels": mask}),
        "icp_system": (icp_system, {"level": level, "T_WC": T_WC, "surface": model, **gates}),
        "brightness_system": (brightness_system, {"level": level, "T_WC": T_WC, **bright}),
        "quadtree": (
            quadtree,
            {"rgb_u8": frame.rgb_u8, "threshold": 0.1, "min_cell_px": 1, "contrast": "std"},
        ),
        "k_nearest": (k_nearest, {"xyz_W": params.xyz_W, "others_W": params.xyz_W[1:], "k": 3}),
        "band_blocks": (band_blocks, {"volume": volume, "frame": frame}),
        "new_band_blocks": (
            lambda **values: new_band_blocks(**values).coords,
            {"volume": volume, "frame": frame},
        ),
        "fuse_frame_": (fuse_frame_, {"volume": volume, "frame": frame}),
        "raycast": (raycast, {"volume": volume, "camera": camera, "T_WC": T_WC}),
        "sample_voxels": (sample_voxels, {"volume": volume, "xyz_W": params.xyz_W}),
        "sample_fused_voxels": (
            sample_fused_voxels,
            {"volume": volume, "frame": closer, "missing": missing, "xyz_W": params.xyz_W},
        ),
        "extract_mesh": (extract_mesh, {"volume": volume, "min_weight": 1.0}),
    }


def copied(value: Any) -> Any:
    """A copy of tensors, which an operation may write to; those with gaps stay as they are."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_contiguous() else value
    if isinstance(value, GaussianParams):
        return GaussianParams(**{name: copied(column) for name, column in vars(value).items()})
    return value


def mutations(
    name: str,
    value: Any,
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """What may be wrong with one operand: a name, and a function that makes it wrong."""
    if isinstance(value, Tensor):
        for what, change in (SHAPES | VALUES.get(name, {})).items():
            if not (
                what == "nothing"
                and name in ("pixels", "rows", "v_depth_m", "v_alpha", "steps", *CENTRES)
            ):
                yield what, lambda change=change: change(value)
    elif isinstance(value, Camera):
        yield "a larger image", lambda: dataclasses.replace(value, width=value.width + 1)
        yield "an enormous image", lambda: dataclasses.replace(value, width=10**6, height=10**6)
        yield "half a pixel", lambda: dataclasses.replace(value, width=value.width + 0.5)
        yield (
            "a principal point that is no number",
            lambda: dataclasses.replace(value, cx=float("nan")),
        )
    elif isinstance(value, float):
        yield "NaN", lambda: float("nan")
        yield "a word", lambda: "many"
    elif dataclasses.is_dataclass(value) and not isinstance(value, (Record, type)):
        for field in dataclasses.fields(value):
            if isinstance(getattr(value, field.name), Tensor):
                for what, change in mutations(field.name, getattr(value, field.name)):
                    yield (
                        f"{field.name}, {what}",
                        lambda field=field, change=change: dataclasses.replace(
                            value, **{field.name: change()}
                        ),
                    )
    elif isinstance(value, ColumnRates):
        for field, rate in value._asdict().items():
            for what, change in mutations(field, rate):
                yield (
                    f"{field}, {what}",
                    lambda field=field, change=change: value._replace(**{field: change()}),
                )
    if not isinstance(value, (float, int, str, Tensor)):
        yield "something else", object


def outcome(run: Callable[[], Any]) -> str | list[tuple[int, float]]:
    """What a call gave: a sentence, or for every image or column of floats its NaNs and the sum of
    the other values."""
    try:
        result = run()
    except ValueError as e:
        return str(e)
    except Exception as e:
        return f"{type(e).__name__}, and no ValueError: {e}"
    return [
        (int(x.isnan().sum()), float(x.nan_to_num(0, 0, 0).double().sum())) for x in floats(result)
    ]


def floats(result: Any) -> Iterator[Tensor]:
    """The tensors of floats in a result."""
    if isinstance(result, Tensor) and result.is_floating_point():
        yield result
    elif isinstance(result, (tuple, list)):
        for part in result:
            yield from floats(part)
    elif dataclasses.is_dataclass(result) and not isinstance(result, Record):
        yield from floats(list(vars(result).values()))


def outcomes(backend: str) -> dict[str, Any]:
    """The outcome of every case."""
    found: dict[str, Any] = {}
    torch.manual_seed(0)
    with use_backend(backend):
        for operation, (function, good) in operations().items():
            if backend == "cuda" and backend not in offered(operation):
                continue
            found[f"{operation}: as it should be"] = outcome(lambda f=function, o=good: f(**o))
            for name, value in good.items():
                for what, change in mutations(name, value):
                    case = f"{operation}: {name}, {what}"
                    found[case] = outcome(
                        lambda f=function, o=good, n=name, c=change: f(**(o | {n: c()}))
                    )
    return found


if __name__ == "__main__":
    json.dump(
        {backend: outcomes(backend) for backend in sys.argv[1:]},
        sys.stdout,
    )
