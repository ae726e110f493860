"""A map in a page of its own: the splat viewer without a kernel, with everything in the page."""

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..drawing.pictures import Picture, to_uint8
from ..render import render
from ..render.constants import NEAR_PLANE_M
from ..types import Camera, GaussianParams
from . import splat_rows, splat_state
from .fewer_rows import merged
from .front_end import ROOM, source, splat_module, splat_style
from .viewpoint import Place, places_of

MOST_ROWS = 80_000
"""A page holds at most this many Gaussians: 2 to 3 MB."""
MOST_READ = 5
"""Of a map with more than this many times the Gaussians of the page, only every second, third, ...
is looked at."""
_BACKGROUND = "#10141a"
_EXPORT = "export default {"
_OFF = {"renderer": "auto", "renderer_used": "", "gpu": "", "stats": {}, "picked": None}


@dataclass(frozen=True, kw_only=True, eq=False)
class PageMap:
    """A map that a page can show."""

    data: str
    """Its rows and the camera as JSON, without "<", for a script element or a file."""
    poster: Picture
    """What it looks like at first, drawn by the library's renderer."""
    has_timeline: bool
    """Whether the page can show how it grew."""
    n: int
    """Gaussians in the page."""
    n_whole: int
    """Gaussians of the map."""

    @property
    def has_fewer(self) -> bool:
        """Whether some Gaussians of the map are not in the page."""
        return self.n < self.n_whole


def page_map(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    up_W: Float[Tensor, "3"],
    *,
    birth_frames: Sequence[int] | Tensor | None = None,
    place: str = "above",
    most_rows: int = MOST_ROWS,
    near_m: float = NEAR_PLANE_M,
) -> PageMap:
    """A map as a page holds it.

    Args:
        params: The map.
        camera: Of the canvas; its size is that of the poster.
        T_WC: Where the button "photo" goes, camera-to-world.
        up_W: The world's up direction.
        birth_frames: Frame that each Gaussian is from, to replay how the map grew. [N]
        place: Where the viewer is at first: "photo", "above" or "inside".
        most_rows: Gaussians in the page, at most; of more, like neighbours become one.
        near_m: Nearer Gaussians are not drawn, metres.
    """
    stride = max(1, len(params) // (MOST_READ * most_rows))  # not all of a map of millions
    read = _on_cpu(params, stride)
    finite = splat_rows.finite_rows(read).nonzero().flatten()
    few, of_finite = merged(read[finite], most_rows)
    rows = stride * finite[of_finite]
    columns = []
    if birth_frames is not None:
        values = torch.as_tensor(birth_frames).cpu()[rows]
        columns = splat_rows.columns_of(few, len(few), {"birth_frame": values})
    places = places_of(few, camera, T_WC, up_W.cpu().float(), near_m)
    start = places[place]
    layout = splat_rows.RowLayout(columns=len(columns), harmonics=1)
    records = splat_rows.pack_rows(few, splat_rows.value_table(columns, len(few)), layout)
    state = {
        **splat_state.view_state(camera, places, up_W.cpu().float()),
        **splat_state.map_state(few, columns),
        "pose": start.T_WC.flatten().tolist(),
        "pivot_m": start.pivot_m,
        "cut_m": start.cut_m,
        "rules": splat_state.rules(near_m),
        "colour_by": "rgb",
        "size": 1.0,
        "opacity": 1.0,
        "points": False,
        "background": _BACKGROUND,
        "born_until": None,
        "record": [],
        "names_renderer": False,
        **_OFF,
    }
    head = {"n": len(few), "stride": layout.stride, "columns": layout.columns, "harmonics": 1}
    content = {"state": state, "head": {**head, "all": True}, "rows": _packed(records)}
    return PageMap(
        data=json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
        poster=_poster(few, camera, start, near_m),
        has_timeline=len(set(state["birth_range"])) > 1,
        n=len(few),
        n_whole=len(params),
    )


def page_script() -> str:
    """What shows every ``.gsnb-moving-map`` of a page that has the data of a map in a script
    element in it, or else the map ``MAP``, a constant put before this text."""
    module = splat_module().replace(_EXPORT, "const VIEWER = {")
    return f"{module}\n{source(ROOM, 'page.js')}"


def page_style() -> str:
    """The style sheet of a page with maps and of the buttons under their posters."""
    return f"{splat_style()}{source(ROOM, 'page.css')}"


def waiting_controls() -> str:
    """HTML of the viewer's buttons, disabled: they stand under a poster until its map has come, and
    not where a page runs no script."""
    return source(ROOM, "waiting.html")


def _on_cpu(params: GaussianParams, stride: int) -> GaussianParams:
    """Every ``stride``-th row, without view-dependent colour."""
    columns = {**vars(params), "sh": params.sh[:, :1]}
    return GaussianParams(**{name: x[::stride].detach().cpu() for name, x in columns.items()})


def _packed(records: UInt8[np.ndarray, "N S"]) -> str:
    """The first bytes of all records, then the second ones, and so on: like stands beside like, so
    that they deflate well. In base64."""
    return base64.b64encode(zlib.compress(records.T.tobytes(), 9)).decode("ascii")


def _poster(params: GaussianParams, camera: Camera, place: Place, near_m: float) -> Picture:
    """The map without what the viewer cuts away at first."""
    depth_m = (params.xyz_W - place.T_WC[:3, 3]) @ place.T_WC[:3, 2]
    view = render(params[depth_m > place.cut_m], camera, place.T_WC, near_m=near_m)
    ground = torch.tensor([int(_BACKGROUND[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return to_uint8(view.rgb + (1 - view.alpha[..., None]) * ground)
