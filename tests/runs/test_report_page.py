"""The report page: parses, loads nothing from outside, shows the numbers, survives whatever is
missing."""

import math
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest
import torch

from gsfusion_nb.config import gps_slam, replace
from gsfusion_nb.evaluation import NotComputed
from gsfusion_nb.evaluation.metrics import format_metric
from gsfusion_nb.mapping import StepReport
from gsfusion_nb.runs import ReportData, ReportPanel, run_mapping, write_report
from gsfusion_nb.runs.side_by_side import write_side_by_side
from gsfusion_nb.types import Camera, Frame, RenderOutput

VOID = {"meta", "link", "img", "br", "input", "hr"}


class Page(HTMLParser):
    """Collects text, references and pictures, and checks that every element is closed in order."""

    def __init__(self, html):
        super().__init__()
        self.open = []
        self.text = []
        self.references = []
        self.images = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.references += [
            values[k] for k in ("src", "href", "xlink:href", "data", "action") if values.get(k)
        ]
        if tag == "img" and values.get("src"):
            self.images.append(values)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).replace("\u00a0", " ").split())


def page_of(run, tmp_path):
    html = write_report(tmp_path / "report.html", run).read_text(encoding="utf-8")
    page = Page(html)
    assert all(ref.startswith(("data:", "#")) for ref in page.references)
    assert "url(http" not in html
    assert "@import" not in html
    assert "nan" not in page.words.lower().split()
    return page


def panel(generator, held_out=False, **changes):
    h = 30
    w = 44
    values = {
        "name": "Frame 7",
        "held_out": held_out,
        "rgb": torch.rand(h, w, 3, generator=generator),
        "render": torch.rand(h, w, 3, generator=generator),
        "depth_m": torch.full((h, w), 2.0),
        "render_depth_m": torch.full((h, w), 2.1),
        "psnr": 21.5,
        "ssim": 0.71,
    }
    return ReportPanel(**{**values, **changes})


def row(index, **changes):
    values = {
        "frame_index": index,
        "n_gaussians": 100 * (index + 1),
        "n_seeds": 100,
        "is_keyframe": index % 2 == 0,
        "psnr_before_db": 15.0,
        "psnr_after_db": 18.0,
        "losses": (0.2, 0.1),
        "seconds": {"integrate": 0.05, "optimise": 0.1},
    }
    return StepReport(**{**values, **changes})


def test_the_whole_page(generator, tmp_path):
    cells = SimpleNamespace(
        x0=torch.tensor([0, 22]),
        y0=torch.tensor([0, 0]),
        width=torch.tensor([22, 22]),
        height=torch.tensor([30, 30]),
        level=torch.tensor([1, 1]),
    )
    run = ReportData(
        title="GSFusion on a <room>",
        subtitle="48 frames",
        metrics={
            "psnr_held_out_db": 23.678,
            "ssim_held_out": 0.8123,
            "n_gaussians": 8386,
            "fps_total": 3.21,
            "n_frames": 42,
            "lpips_held_out": NotComputed("package 'lpips' is not installed"),
            "mesh_accuracy_m": 0.0072,
            "my_own": 1.5,
        },
        config={"tsdf": {"voxel_size_m": 0.01, "sdf": "ray"}, "seed": 0, "options": {}},
        frames=[row(i) for i in range(6)],
        global_losses=[0.2, 0.1],
        views=[panel(generator, cells=cells), panel(generator, held_out=True, name="Frame 4")],
        mesh_pictures={"From above": torch.rand(20, 30, 3, generator=generator)},
        warnings=["Stopped at frame 5: depth is truncated."],
        environment={"torch": "2.x", "threads": 1},
        files={"gaussians.ply": "8,386 Gaussians: SuperSplat", "notes.txt": "own"},
    )
    page = page_of(run, tmp_path)
    for text in (
        "GSFusion on a <room>",
        "Stopped at frame 5",
        "23.68 dB",
        "SSIM 0.812",
        "8,386",
        "3.21 frames/s",
        "of 42 frames",
        "not computed: package 'lpips' is not installed",
        "0.72 cm",
        "my_own",
        "tsdf.voxel_size_m",
        "0.01",
        "threads",
        "SuperSplat",
        "notes.txt",
        "PSNR 21.50 dB · SSIM 0.710",
        "Quadtree",
        "2 cells",
        "2.00 m",
        "10 cm or more",
        "All 6 frames",
    ):
        assert text in page.words, text
    assert len(page.images) == 6 + 6 + 1 + 1 + 5  # the last ones are graphs
    assert page.words.index("Frame 4") < page.words.index("Frame 7")


def test_a_title_alone_is_a_page(tmp_path):
    page = page_of(ReportData(title="Nothing yet"), tmp_path)
    assert page.words == "Nothing yet Nothing yet"


def test_missing_numbers_give_their_reason(tmp_path):
    metrics = {"psnr_held_out_db": NotComputed("no frame was held out"), "psnr_mapped_db": math.nan}
    words = page_of(ReportData(title="t", metrics=metrics), tmp_path).words
    assert "not computed: no frame was held out" in words
    assert "not computed: the result is not a number" in words
    assert "not computed: not measured in this run" in words


@pytest.mark.parametrize(
    "changes",
    [
        {"depth_m": torch.zeros(30, 44), "render_depth_m": torch.zeros(30, 44)},
        {
            "render": torch.full((30, 44, 3), math.nan),
        },
    ],
)
def test_views_with_holes(generator, tmp_path, changes):
    page = page_of(ReportData(title="t", views=[panel(generator, **changes)]), tmp_path)
    assert "Render" in page.words


@pytest.mark.parametrize(
    "frames",
    [
        [row(0)],
        [
            row(i, psnr_after_db=math.nan, psnr_before_db=math.nan, losses=(), is_keyframe=False)
            for i in range(3)
        ],
    ],
)
def test_frames_with_holes(tmp_path, frames):
    page = page_of(ReportData(title="t", frames=frames), tmp_path)
    assert f"All {len(frames)} frames" in page.words


def test_panel_of_a_frame_scores_the_render(generator):
    camera = Camera(
        width=8,
        height=8,
        fx=8.0,
        fy=8.0,
        cx=4.0,
        cy=4.0,
    )
    rgb = torch.rand(8, 8, 3, generator=generator)
    depth = torch.ones(8, 8)
    index = torch.zeros(8, 8, dtype=torch.int64)
    frame = Frame(
        index=12,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth,
        camera=camera,
        T_WC=torch.eye(4),
    )
    view = RenderOutput(
        rgb=rgb, depth_m=depth * 0.8, alpha=depth * 0.8, first_index=index, dominant_index=index
    )
    made = ReportPanel.of(frame, view, held_out=True)
    assert (made.name, made.psnr, made.ssim) == ("Frame 12", math.inf, 1.0)
    assert torch.allclose(made.render_depth_m, depth)


@pytest.mark.ci
def test_two_systems_side_by_side(config, tmp_path):
    configs = {"one": config, "other": replace(gps_slam("room", final__passes=0), data=config.data)}
    runs = [
        run_mapping("room", c, folder=tmp_path / name, n_frames=120, width=80, height=60)
        for name, c in configs.items()
    ]
    page = Page(write_side_by_side(tmp_path / "report.html", runs).read_text(encoding="utf-8"))
    assert {ref for ref in page.references if not ref.startswith("data:")} == {
        "one/report.html",
        "other/report.html",
    }
    assert all((tmp_path / name / "report.html").is_file() for name in configs)
    assert "GSFusion and GPS-SLAM on room" in page.words
    not_scored = replace(runs[0], report=None)
    with pytest.raises(ValueError, match="one was not scored"):
        write_side_by_side(tmp_path / "report.html", [not_scored, runs[1]])
    assert page.words.index("Photograph and map") < page.words.index("Numbers")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    opening = text[text.index('<section class="opening"') : text.index("</section>")]
    heads = re.findall(
        r"<div>\s*<h2>([^<]*)</h2>\s*<(?:div class=.gsnb-moving-map|figure)", opening
    )
    assert heads == ["GSFusion", "GPS-SLAM", "Photograph"]  # each directly above its picture
    assert f"a surface that {len(runs[1].run.mapper.gaussians):,} Gaussians correct" in page.words
    assert "how near the drawn pictures are to photographs" in page.words
    for run in runs:
        assert (
            format_metric("psnr_held_out_db", run.metrics["psnr_held_out_db"]).replace(
                "\u00a0", " "
            )
            in page.words
        )
