"""The values that travel between the rooms: camera, frame, seeds, render output. Frozen; inputs are
never modified."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from .arrays import colour_tensor, depth_tensor, pose_tensor
from .checks import check_number, check_positive, check_shape
from .errors import ArgumentError, UnknownNameError

MAX_SIDE_PX = 1 << 16
MAX_PIXELS = 1 << 27
"""Larger images would not fit into memory, and into the 32-bit numbers that kernels count pixels
with."""


MapRows = slice | Int[Tensor, " R"]
"""A part of a map: numbers of its rows, each once, or a slice, such as ``ALL_ROWS``. Columns are
indexed by it."""

ALL_ROWS = slice(None)
"""A map as a whole: a column that is indexed by it is a view, not a copy."""


def rgb_of_bytes(levels: UInt8[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Colour 0..1 of grey levels 0..255."""
    return levels.float().div_(255.0)


def _taken(columns: dict[str, Tensor], rows: Any) -> dict[str, Tensor]:
    """Rows of every column. A mask is searched once, and whole rows are copied faster than by
    indexing."""
    if isinstance(rows, Tensor) and rows.ndim == 1 and rows.dtype in (torch.bool, torch.int64):
        n = len(next(iter(columns.values())))
        places = (
            rows.nonzero()[:, 0]
            if rows.dtype == torch.bool
            else torch.where(rows < 0, rows + n, rows)
        )
        return {
            name: column.index_select(0, places.to(column.device))
            for name, column in columns.items()
        }
    return {name: column[rows] for name, column in columns.items()}


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera without distortion. Pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""

    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point, x, in pixel-edge coordinates (width / 2 is the image centre)."""
    cy: float
    """Principal point, y, in pixel-edge coordinates."""

    def __post_init__(self):
        for name in ("width", "height", "fx", "fy"):
            check_positive(f"camera {name}", getattr(self, name))
        for name in ("cx", "cy"):
            check_number(f"camera {name}", getattr(self, name))
        if not all(isinstance(n, int) and n <= MAX_SIDE_PX for n in (self.width, self.height)):
            raise ArgumentError(
                f"camera width and height must be whole numbers up to {MAX_SIDE_PX}, got "
                f"{self.width} x {self.height}"
            )
        if self.width * self.height > MAX_PIXELS:
            raise ArgumentError(
                f"an image may have {MAX_PIXELS} pixels, got {self.width} x {self.height}"
            )

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix, float64."""
        return torch.tensor(
            [[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]],
            dtype=torch.float64,
        )

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on another pixel grid (edges stay edges, so the principal point scales
        without a shift)."""
        sx = width / self.width
        sy = height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )


@dataclass(frozen=True, kw_only=True, eq=False, init=False)
class Frame:
    """One RGB-D observation with its pose.

    ``Frame(rgb=...)`` takes colour as it is: an 8-bit image as uint8, anything else as float32,
    0..1. Bytes are carried as bytes; ``frame.rgb`` makes floats of them when they are first asked
    for, and keeps them.

    Images and pose may be NumPy arrays, which are copied: colour in the order red, green, blue as
    uint8 or as floats in 0..1, depth as floats in metres. ``conversions`` says what was made of
    them.

    Raises:
        ValueError: a tensor of the wrong type or shape, or an array whose scale is not known, such
            as depth in whole numbers.
    """

    index: int
    """Position in the source sequence (stride and held-out frames keep the source's numbers)."""
    timestamp_s: float
    """Time of the observation, seconds."""
    colour: UInt8[Tensor, "H W 3"] | Float[Tensor, "H W 3"]
    """Colour as it was given: grey levels 0..255 as uint8, or float32, 0..1."""
    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where there is none, never NaN."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose, OpenCV axes, metres."""
    extra: Mapping[str, Shaped[Tensor, "H W *C"]]
    """Further images of this frame by name, such as labels of a segmentation (whole numbers) or
    uncertainties (floats, finite). They are resized with the frame, and reach seeding rules and
    a loss that was given to the mapper; without one, keyframes and checkpoints do not keep
    them."""

    def __init__(
        self,
        *,
        index: int,
        timestamp_s: float,
        depth_m: Tensor | np.ndarray,
        camera: Camera,
        T_WC: Tensor | np.ndarray,
        rgb: Tensor | np.ndarray | None = None,
        colour: Tensor | np.ndarray | None = None,
        extra: "Mapping[str, Tensor | np.ndarray] | None" = None,
    ):
        colour = colour if rgb is None else rgb  # dataclasses.replace(frame, rgb=...) gives both
        given = {"rgb": colour, "depth_m": depth_m, "T_WC": T_WC}
        arrays = {name: x for name, x in given.items() if isinstance(x, np.ndarray)}
        tensors = {
            name: _OF_ARRAY[name](f"{name} of frame {index}", x) for name, x in arrays.items()
        }
        self.__dict__["_conversions"] = tuple(
            f"{name}: numpy.ndarray of {x.dtype} copied to a torch.Tensor of "
            f"{str(tensors[name].dtype).removeprefix('torch.')}"
            for name, x in arrays.items()
        )
        colour, depth_m, T_WC = (given | tensors).values()
        size = (camera.height, camera.width)
        for name, value, shape in (
            ("rgb", colour, (*size, 3)),
            ("depth_m", depth_m, size),
            ("T_WC", T_WC, (4, 4)),
        ):
            types = (torch.float32, torch.uint8) if name == "rgb" else (torch.float32,)
            if not isinstance(value, Tensor) or value.dtype not in types:
                kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
                wanted = " or ".join(str(t).removeprefix("torch.") for t in types)
                raise ArgumentError(
                    f"{name} of frame {index} must be a {wanted} torch.Tensor, got {kind}"
                )
            check_shape(name, value, shape)
        found = _checked_extra(index, extra or {}, size)
        for field, value in zip(
            dataclasses.fields(self),
            (index, timestamp_s, colour, depth_m, camera, T_WC, found),
            strict=True,
        ):
            object.__setattr__(self, field.name, value)

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors, from which ``of_state`` makes the frame again."""
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return parts | {"camera": vars(self.camera), "extra": dict(self.extra)}

    @staticmethod
    def of_state(state: dict[str, Any]) -> "Frame":
        """The frame of which ``state_dict`` gave the values.

        Raises:
            ValueError: a value of the wrong type or shape.
        """
        return Frame(**{**state, "camera": Camera(**state["camera"])})

    @property
    def conversions(self) -> tuple[str, ...]:
        """What was made of the NumPy arrays that were given, a sentence for each: "depth_m:
        numpy.ndarray of float64 copied to a torch.Tensor of float32"."""
        return self.__dict__["_conversions"]

    @property
    def is_8_bit(self) -> bool:
        """Whether colour was given in bytes."""
        return self.colour.dtype == torch.uint8

    @functools.cached_property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colour, 0..1."""
        return rgb_of_bytes(self.colour) if self.is_8_bit else self.colour

    @property
    def rgb_u8(self) -> UInt8[Tensor, "H W 3"]:
        """Colour in grey levels 0..255: the bytes that were given, or floats rounded."""
        if self.is_8_bit:
            return self.colour
        return (self.colour * 255.0).round_().clamp_(0, 255).to(torch.uint8)

    @functools.cached_property
    def T_WC_cpu(self) -> Float[Tensor, "4 4"]:
        """The pose in CPU memory; of a frame that was moved to a GPU, it is known without waiting
        for the GPU."""
        return self.T_WC.detach().cpu()

    def to(self, device: torch.device | str) -> "Frame":
        """The same frame with its tensors on ``device``, contiguous; the frame itself if they are.

        To a GPU they are copied without waiting for it, except from pinned memory, which its owner
        may write to next.
        """
        moved = {
            name: _moved(getattr(self, name), torch.device(device))
            for name in ("colour", "depth_m", "T_WC")
        }
        extra = {name: _moved(value, torch.device(device)) for name, value in self.extra.items()}
        same = [value is getattr(self, name) for name, value in moved.items()]
        if all([*same, *(value is self.extra[name] for name, value in extra.items())]):
            return self
        frame = dataclasses.replace(self, **moved, extra=Extras(extra))
        frame.__dict__["T_WC_cpu"] = self.T_WC_cpu
        return frame


_OF_ARRAY = {"rgb": colour_tensor, "depth_m": depth_tensor, "T_WC": pose_tensor}
"""What makes a tensor of each part of a frame that is given as a NumPy array."""


class Extras(dict[str, Tensor]):
    """``Frame.extra``: an image that is not there is an error that lists those that are."""

    def __missing__(self, name: str) -> Tensor:
        raise UnknownNameError(
            f"this frame has no extra image {name!r}; it has: {', '.join(self) or 'none'}"
        )


def _checked_extra(
    index: int, extra: "Mapping[str, Tensor | np.ndarray]", size: tuple[int, int]
) -> Extras:
    if isinstance(extra, Extras):
        if any(value.shape[:2] != size for value in extra.values()):
            shapes = {name: list(value.shape) for name, value in extra.items()}
            raise ArgumentError(
                f"extra of frame {index} must be [{size[0]}, {size[1]}, ...], got {shapes}"
            )
        return extra
    found = Extras()
    for name, value in extra.items():
        image = (
            torch.from_numpy(np.ascontiguousarray(value))
            if isinstance(value, np.ndarray)
            else value
        )
        if not isinstance(image, Tensor) or image.shape[:2] != size:
            got = list(image.shape) if isinstance(image, Tensor) else type(image).__name__
            raise ArgumentError(
                f"extra {name!r} of frame {index} must be an image [{size[0]}, {size[1]}, ...], "
                f"got {got}"
            )
        if image.is_floating_point() and not bool(image.isfinite().all()):
            raise ArgumentError(
                f"extra {name!r} of frame {index} must be finite, got NaN or infinity; give 0 or a "
                "mask"
            )
        found[name] = image
    return found


def _moved(tensor: Tensor, device: torch.device) -> Tensor:
    uploads = tensor.device.type == "cpu" and device.type == "cuda"
    return tensor.to(device, non_blocking=uploads and not tensor.is_pinned()).contiguous()


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeds:
    """New Gaussians, one row each, as a seeding rule proposes them. ``seeds[mask]`` filters every
    column at once."""

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    rgb: Float[Tensor, "N 3"]
    """Colour, 0..1."""
    scale_m: Float[Tensor, "N 3"]
    """Standard deviation along the Gaussian's own axes, metres."""
    quat: Float[Tensor, "N 4"]
    """Orientation, wxyz."""
    opacity: Float[Tensor, " N"]
    """Peak opacity, in (0, 1)."""
    tag: Int[Tensor, " N"]
    """Free label carried into the map; the quadtree rules put the cell's depth in the tree here."""

    def __len__(self) -> int:
        return self.xyz_W.shape[0]

    def __getitem__(self, rows) -> "Seeds":
        return Seeds(**_taken(vars(self), rows))

    @staticmethod
    def isotropic(
        xyz_W: Float[Tensor, "N 3"],
        rgb: Float[Tensor, "N 3"],
        radius_m: Float[Tensor, " N"],
        *,
        opacity: float = 0.5,
        tag: Int[Tensor, " N"] | None = None,
    ) -> "Seeds":
        """Round Gaussians with identity orientation (GSFusion III-B.2: R = I, S = diag(d, d, d),
        alpha = 0.5)."""
        n = xyz_W.shape[0]
        quat = xyz_W.new_zeros(n, 4)
        quat[:, 0] = 1.0
        return Seeds(
            xyz_W=xyz_W,
            rgb=rgb,
            scale_m=radius_m[:, None].expand(n, 3).clone(),
            quat=quat,
            opacity=xyz_W.new_full((n,), opacity),
            tag=torch.zeros(n, dtype=torch.int32, device=xyz_W.device)
            if tag is None
            else tag.to(torch.int32),
        )

    @staticmethod
    def empty(like: Tensor | None = None) -> "Seeds":
        """No rows, on the device of ``like``."""
        zeros = torch.zeros if like is None else like.new_zeros
        return Seeds.isotropic(
            zeros((0, 3)),
            zeros((0, 3)),
            zeros((0,)),
        )

    @staticmethod
    def cat(parts: "list[Seeds]") -> "Seeds":
        """Rows of all ``parts``, in order."""
        if not parts:
            return Seeds.empty()
        return Seeds(
            **{
                f.name: torch.cat([getattr(p, f.name) for p in parts])
                for f in dataclasses.fields(Seeds)
            }
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderOutput:
    """What a camera sees of the Gaussian map, or B cameras do, each in its own picture."""

    rgb: Float[Tensor, "*B H W 3"]
    """Blended colour over the background, black by default; not clamped."""
    depth_m: Float[Tensor, "*B H W"]
    """Blended z-depth, sum of w_k z_k: not divided by alpha, so 0 where nothing is."""
    alpha: Float[Tensor, "*B H W"]
    """Accumulated opacity, 1 - transmittance."""
    first_index: Int[Tensor, "*B H W"] | None
    """Row of the nearest Gaussian that contributes at the pixel; -1 where none does. ``None`` if
    not asked for."""
    dominant_index: Int[Tensor, "*B H W"] | None
    """Row of the Gaussian with the largest weight at the pixel; -1 where none has any. ``None`` if
    not asked for."""
    hit_index: Int[Tensor, "*B H W"] | None = None
    """Row of the nearest Gaussian that is opaque at the pixel, blended or not, or -1. ``None`` if
    not asked for."""
    surface_depth_m: Float[Tensor, "*B H W"] | None = None
    """z-depth of the surface, metres, 0 where there is none; only for maps that have a surface
    (RTG-SLAM's discs)."""
    features: Float[Tensor, "*B H W F"] | None = None
    """Blended features, sum of w_k f_k. ``None`` if none were given."""

    def to(self, device: torch.device | str) -> "RenderOutput":
        """The same images on ``device``."""
        moved = {name: x.to(device) for name, x in vars(self).items() if x is not None}
        return dataclasses.replace(self, **moved)


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianParams:
    """The optimised numbers of a Gaussian map, one row each, before activation. Gradients have the
    same shape.

    A row stands for the density G(x) = exp(-(x - xyz_W)^T Sigma^-1 (x - xyz_W) / 2) (GSFusion Eq.
    1).
    """

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    log_scale: Float[Tensor, "N 3"]
    """Logarithm of the standard deviation in metres, along the Gaussian's own axes."""
    quat: Float[Tensor, "N 4"]
    """Orientation, wxyz, normalised at use."""
    opacity_logit: Float[Tensor, " N"]
    """Logit of the peak opacity."""
    sh: Float[Tensor, "N K 3"]
    """Spherical-harmonic coefficients of the colour; K = (degree + 1)^2, coefficient 0 is the
    constant one."""

    def __len__(self) -> int:
        return self.xyz_W.shape[0]

    def __getitem__(self, rows) -> "GaussianParams":
        return GaussianParams(**_taken(vars(self), rows))

    @property
    def sh_degree(self) -> int:
        """Degree of the colour's spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5) - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A coloured triangle mesh with shared vertices.

    Raises:
        ValueError: a face of a vertex that is not there.
    """

    vertices_W: Float[Tensor, "V 3"]
    """Positions, world frame, metres."""
    faces: Int[Tensor, "F 3"]
    """Vertex indices, counter-clockwise seen from the free side."""
    rgb: Float[Tensor, "V 3"]
    """Vertex colours, 0..1."""

    def __post_init__(self):
        if not self.faces.numel():
            return
        low, high = torch.stack(torch.aminmax(self.faces)).tolist()
        if low < 0 or high >= len(self.vertices_W):
            raise ArgumentError(
                f"faces must refer to vertices 0 to {len(self.vertices_W) - 1}, got {low} to {high}"
            )
