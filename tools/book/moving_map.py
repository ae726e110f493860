"""The map of the built-in room that turns on the first page of the book, without a kernel."""

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import SplatViewer


@dataclass(frozen=True, kw_only=True)
class MovingMap:
    """The map that turns, and what stands for it elsewhere."""

    script: str
    """Puts the map, seen from above, into every element of the class ``gsnb-moving-map``."""
    poster: bytes
    """Its first picture as WebP, 480x360, which the pages show until the script has drawn."""
    share: bytes
    """A picture as JPEG, 1200x630, which other sites show beside a link to the book."""


SHARE_TITLE = "3D Gaussian splatting and RGB-D mapping"
SHARE_LINE = "a course in your browser, every formula a line of code"
_SHARE_SIZE = (1200, 630)


def moving_map() -> MovingMap:
    """Map the room and draw it."""
    options = {
        "data__width": 240,
        "data__height": 180,
        "tsdf__voxel_size_m": 0.04,
        "optim__global_iterations": 6,
    }
    config = gsfusion("room", sh_degree=0, seeding__quadtree_threshold=0.02, **options)
    run = MappingRun(open_sequence("room", data=config.data, n_frames=60), GSFusion(config))
    for _ in (*run.online(), *run.optimise()):
        pass
    viewer = SplatViewer(run.mapper, width=480, height=360).look_from("above")
    poster = io.BytesIO()
    Image.fromarray(viewer.picture()).save(poster, "WEBP", quality=75, method=6)
    return MovingMap(
        script=_script(viewer), poster=poster.getvalue(), share=_share_picture(run.mapper)
    )


def _script(viewer: SplatViewer) -> str:
    frames_sent = []
    # what the page would get
    viewer.send = lambda content, buffers: frames_sent.extend((content["head"], *buffers))
    viewer._on_message(None, {"kind": "ready"}, [])
    state = {
        name: value
        for name, value in viewer.get_state().items()
        if name[0] != "_" and name in SplatViewer.__dict__
    }
    rows = base64.b64encode(frames_sent[1]).decode("ascii")
    values = {"STYLE": str(viewer._css), "STATE": state, "HEAD": frames_sent[0], "ROWS": rows}
    constants = "\n".join(f"const {name} = {json.dumps(value)};" for name, value in values.items())
    module = str(viewer._esm).replace("export default {", "const VIEWER = {")
    start = (Path(__file__).parent / "static/moving_map.js").read_text(encoding="utf-8")
    return f"(() => {{\n{module}\n{constants}\n{start}}})();\n"


def _share_picture(mapper: GSFusion) -> bytes:
    """The map from above with the name of the book under it."""
    width, height = _SHARE_SIZE
    band = 150
    viewer = SplatViewer(mapper, width=width, height=height - band).look_from("above")
    picture = Image.new("RGB", _SHARE_SIZE, "#0b0e12")
    picture.paste(Image.fromarray(viewer.picture()), (0, 0))
    draw = ImageDraw.Draw(picture)
    for text, size, top in ((SHARE_TITLE, 52, 24), (SHARE_LINE, 34, 90)):
        font = ImageFont.load_default(size)
        draw.text((width / 2, height - band + top), text, "#ffffff", font, anchor="ma")
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=82)
    return file.getvalue()
