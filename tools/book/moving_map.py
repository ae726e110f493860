"""The map of the built-in room that turns on the first page of the book, without a kernel."""

import io
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.geometry.upright import world_up
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viewer.page_map import page_map, page_script
from gsfusion_nb.viewer.viewpoint import viewing_camera
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
    sequence = open_sequence("room", data=config.data, n_frames=60)
    run = MappingRun(sequence, GSFusion(config))
    for _ in (*run.online(), *run.optimise()):
        pass
    camera = viewing_camera(sequence.camera, 480, 360)
    keyframes = run.mapper.keyframes
    shown = page_map(
        run.mapper.gaussians.params,
        camera,
        keyframes[0].T_WC,
        world_up([keyframe.T_WC for keyframe in keyframes]),
        birth_frames=run.mapper.gaussians.birth_frame,
    )
    poster = io.BytesIO()
    Image.fromarray(shown.poster).save(poster, "WEBP", quality=75, method=6)
    return MovingMap(
        script=f"(() => {{\nconst MAP = {shown.data};\n{page_script()}}})();\n",
        poster=poster.getvalue(),
        share=_share_picture(run.mapper),
    )


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
