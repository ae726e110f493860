"""Pictures, small graphs and HTML: types, sizes, colours by hand, escaped texts."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from jinja2 import UndefinedError
from markupsafe import Markup
from matplotlib.lines import Line2D

from gsfusion_nb.drawing import curves, pictures
from gsfusion_nb.drawing.curves import PALETTE, curve_figure
from gsfusion_nb.drawing.encoding import data_uri, encode_palette, encode_png
from gsfusion_nb.drawing.live_curves import small_curves
from gsfusion_nb.drawing.page import fill, html_table
from gsfusion_nb.drawing.pictures import CARD, LABEL_PX, side_by_side
from gsfusion_nb.viz.map_pictures import CAUSES


def decoded(data):
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]


def test_to_uint8_rounds_clamps_and_copies():
    image = torch.tensor([[[0.0, 0.5, 1.0], [-1.0, 2.0, math.nan]]])
    assert pictures.to_uint8(image).tolist() == [[[0, 128, 255], [0, 255, 0]]]
    assert pictures.to_uint8(image.numpy()).dtype == np.uint8
    already = np.full((2, 2, 3), 7, np.uint8)
    copy = pictures.to_uint8(already)
    copy[:] = 0
    assert (already == 7).all()


def test_depth_colours_run_from_near_to_far_and_missing_is_grey():
    depth = torch.tensor([[0.0, 1.0, 2.0, 3.0, 0.5, 9.0, math.nan]])
    image = pictures.colour_depth(depth, 1.0, 3.0)
    assert image.shape == (1, 7, 3)
    assert image.dtype == np.uint8
    missing, near, middle, far, nearer, farther, nan = image[0].astype(int)
    assert missing.max() == missing.min()
    assert nan.max() == nan.min()
    assert (nearer == near).all()
    assert (farther == far).all()
    assert near[2] > near[0] > near[1]  # dark blue
    assert middle[1] > 200  # green
    assert far[0] > far[2] + 100  # red
    with pytest.raises(ValueError, match="far_m must be above near_m"):
        pictures.colour_depth(depth, 2.0, 2.0)


def test_error_maps_by_hand():
    black = torch.zeros(1, 3, 3)
    off = torch.tensor([[[0.0, 0, 0], [0.125, 0.125, 0.125], [0.75, 0, 0]]])
    none, half, full = pictures.error_map(off, black, limit=0.25)[0].astype(int)
    assert none.sum() < 20
    assert none.sum() < half.sum() < full.sum()
    assert full.min() > 150
    depth = pictures.depth_error_map(
        torch.tensor([[1.0, 1.1, 0.0]]),
        torch.ones(1, 3),
    )
    assert depth[0, 0].sum() < 20
    assert depth[0, 1].min() > 150
    assert depth[0, 2].max() == depth[0, 2].min() > 20
    with pytest.raises((ValueError, TypeCheckError)):
        pictures.error_map(black, torch.zeros(2, 3, 3))
    with pytest.raises((ValueError, TypeCheckError)):
        pictures.depth_error_map(torch.zeros(2, 3), torch.zeros(1, 3))


def cells(*rows):
    columns = torch.tensor(rows, dtype=torch.int32).reshape(-1, 5).T
    return SimpleNamespace(
        **dict(zip(("x0", "y0", "width", "height", "level"), columns, strict=True))
    )


def test_cell_borders_are_drawn_and_insides_are_not():
    grey = torch.full((17, 25, 3), 0.5)
    image = pictures.paint_cells(
        grey,
        cells((0, 0, 12, 16, 1), (12, 0, 12, 16, 2)),
        strength=1.0,
    )
    assert image.shape == (17, 25, 3)
    assert (image[1:16, 1:12] == 128).all()
    assert (image[1:16, 13:24] == 128).all()
    assert (image[8, [0, 12, 24]] != 128).any(axis=-1).all()
    assert (image[8, 0] != image[8, 24]).any()  # another level, another colour
    assert (grey == 0.5).all()
    same = pictures.paint_cells(
        grey,
        cells((0, 0, 12, 16, 1), (12, 0, 12, 16, 2)),
        by_level=False,
        strength=1.0,
    )
    assert (same[8, 0] == same[8, 24]).all()


def test_side_by_side_fits_heights_and_labels():
    a = torch.zeros(40, 50, 3)
    b = np.full((20, 30, 3), 200, np.uint8)
    row = side_by_side([a, b], ["input", "a label that is much too long for its narrow picture"])
    assert row.shape == (40 + LABEL_PX, 50 + 6 + 60, 3)
    assert row.dtype == np.uint8
    assert side_by_side([a]).shape == (40, 50, 3)
    assert (row[:LABEL_PX] > 200).any()  # light words
    assert (row[0, 0] == CARD).all()
    with pytest.raises(ValueError, match="at least one image"):
        side_by_side([])
    with pytest.raises(ValueError, match="one label per image, got 1 labels for 2"):
        side_by_side([a, b], ["one"])


def test_curve_figure_has_labels_a_legend_and_no_pyplot():
    import sys

    figure = curves.curve_figure(
        [0, 1, 3],
        {"a": [1.0, math.nan, 2.0], "b": [2.0, 2.0, 5.0]},
        x_label="frame",
        y_label="PSNR, dB",
        marks=[0, 3],
        marks_label="keyframe",
    )
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("frame", "PSNR, dB")
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["a", "b", "keyframe"]
    words = "Graph of PSNR, dB over frame: a, b, keyframe"
    assert curves.figure_words(figure) == words
    assert curves.figure_picture(figure).shape == (300, 520, 3)
    png = cv2.imdecode(np.frombuffer(curves.figure_png(figure), np.uint8), cv2.IMREAD_UNCHANGED)
    assert png is not None
    assert png.shape == (300, 520, 4)
    assert (png[..., 3] == 0).mean() > 0.8  # no ground of its own
    ink = png[png[..., 3] == 255][:, :3].astype(int)
    assert ink.min() > 40  # nothing that is lost on a dark page
    assert ink.max(axis=1).min() < 230  # nor on a white one
    assert getattr(sys.modules.get("matplotlib.pyplot"), "get_fignums", list)() == []


# Machado, Oliveira and Fernandes 2009, full severity: linear RGB -> what the eye tells apart
_EYES = {
    "all cones": np.eye(3),
    "no red cones": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green cones": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue cones": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def as_seen(colours, eye):
    """CIELAB of "#rrggbb" as an eye sees them. [N, 3]"""
    linear = (np.array([curves.rgb_of(c) for c in colours]) / 255) ** 2.2
    seen = np.clip(linear @ np.array(_EYES[eye]).T, 0, 1) ** (1 / 2.2)
    return cv2.cvtColor(seen.astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0]


@pytest.mark.parametrize(("eye", "apart"), [(e, 14 if e == "no blue cones" else 18) for e in _EYES])
def test_colours_of_curves_can_be_told_apart(eye, apart):
    lab = as_seen(PALETTE, eye)
    distance = np.linalg.norm(lab[:, None] - lab, axis=2) + 1000 * np.eye(len(lab))
    assert distance.min() > apart


@pytest.mark.parametrize("eye", _EYES)
def test_causes_over_a_grey_picture_can_be_told_apart(eye):
    for grey in (70, 130, 190):
        causes = [0.35 * grey + 0.65 * np.array(rgb) for _, rgb in CAUSES.values()]
        written = [f"#{int(r):02x}{int(g):02x}{int(b):02x}" for r, g, b in [*causes, [grey] * 3]]
        lab = as_seen(written, eye)
        distance = np.linalg.norm(lab[:, None] - lab, axis=2) + 1000 * np.eye(len(lab))
        assert distance.min() > 16, grey


def test_colours_of_curves_can_be_seen_on_every_ground():
    def luminance(colours):
        linear = (np.array([curves.rgb_of(c) for c in colours]) / 255) ** 2.2
        return linear @ (0.2126, 0.7152, 0.0722)

    lightness = luminance(PALETTE)
    assert (1.05 / (lightness + 0.05)).min() > 2.2
    assert ((lightness + 0.05) / (luminance([curves.CARD]) + 0.05)).min() > 2.2


def line_columns(image):
    return np.nonzero((np.abs(image.astype(int) - curves.rgb_of(PALETTE[0])).sum(-1) < 60).any(0))[
        0
    ]


def test_logarithmic_axes_make_a_power_a_straight_line():
    x = [1, 10, 100]
    figure = curves.curve_figure(
        x, {"1 / x": [1, 0.1, 0.01]}, x_label="x", y_label="y", logarithmic=True
    )
    (axes,) = figure.axes
    figure.canvas.draw()
    points = axes.transData.transform(axes.lines[0].get_xydata())
    first, middle, last = points
    assert middle == pytest.approx((first + last) / 2)


def test_a_value_between_two_gaps_is_a_point():
    values = [1.0, math.nan, 2.0, math.nan, 3.0, 4.0, math.nan, 5.0]
    series = {"a": values, "b": [1.0] * 8}
    figure = curves.curve_figure(range(8), series, x_label="x", y_label="y")
    marked = [line.get_markevery() for line in figure.axes[0].lines]
    assert marked == [[0, 2, 7], []]


def test_a_curve_on_an_earlier_one_lets_it_be_seen():
    mean = [0.1, 0.06, 0.05, 0.04]
    series = {"last": [0.1, 0.11, 0.1, 0.1], "fused": mean, "mean": [m + 1e-5 for m in mean]}
    figure = curves.curve_figure([1, 2, 3, 4], series, x_label="windows", y_label="error")
    picture = curves.figure_picture(figure).astype(int)[60:]  # below the legend
    for colour in PALETTE[:3]:
        assert (np.abs(picture - curves.rgb_of(colour)).sum(-1) < 60).sum() > 80, colour


def test_curves_can_be_told_apart_without_any_colour():
    """Along each, the shares of ink and the lengths of strokes differ; the legend shows them."""
    series = {f"curve {i}": [float(i)] * 2 for i in range(len(PALETTE))}
    figure = curves.curve_figure([0, 1], series, x_label="x", y_label="y")
    grey = curves.figure_picture(figure).mean(-1)
    (axes,) = figure.axes
    (legend,) = figure.legends
    height = figure.bbox.height
    seen = set()
    for i, sample in enumerate(legend.legend_handles):
        _, y = axes.transData.transform((0, i))
        x0, x1 = axes.bbox.x0 + 8, axes.bbox.x1 - 8
        row = grey[int(height - y), int(x0) : int(x1)]
        is_ink = row < (row.min() + 255) / 2
        edges = np.flatnonzero(np.diff(is_ink.astype(int)))
        lengths = np.diff(edges)[:12]
        seen.add(tuple(sorted(set(lengths.tolist()))))
        assert isinstance(sample, Line2D)
        assert sample.get_linestyle() == axes.lines[i].get_linestyle()
    assert len(seen) == len(PALETTE)


def test_a_small_curve_fills_as_much_as_is_done_and_nan_leaves_a_gap():
    done = line_columns(
        small_curves(
            {"a": [0, 1, 2, 3, 4]},
            n_x=9,
            width=400,
        )
    )
    assert 50 <= done.min() < 70
    assert done.max() == pytest.approx((50 + 392) / 2, abs=6)
    values = [1.0] * 10 + [math.nan] * 10 + [2.0] * 10
    assert np.diff(line_columns(small_curves({"a": values}, n_x=30, width=400))).max() > 60


def test_texts_are_escaped_and_markup_is_not():
    html = html_table([("<a>", Markup("<b>x</b>"))], heads=("1 < 2", "&"))
    assert "&lt;a&gt;" in html
    assert "<b>x</b>" in html
    assert "1 &lt; 2" in html
    assert "&amp;" in html
    assert "<a>" not in html


def test_a_value_that_is_not_given_is_an_error():
    with pytest.raises(UndefinedError, match="'verdict' is undefined"):
        fill("verdict.html", colour="red")


@pytest.mark.parametrize(
    "names",
    [
        ("frame to frame, from the last pose", "frame to frame, from the prediction", "to model"),
        ("opacity 0.9", "opacity 0.3", "opacity 0.05"),
        ("as it was recorded", "with the corrections", "keyframes and more"),
    ],
)
def test_every_name_of_a_legend_lies_in_the_picture(names):
    series = {name: [0.0, 1.0] for name in names}
    figure = curve_figure([0, 1], series, x_label="frame", y_label="cm")
    figure.canvas.draw()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(names)
    for text in legend.get_texts():
        box = text.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= figure.bbox.width


def test_a_graph_is_stored_with_few_colours():
    """A quarter of the size; its colours are the same."""
    figure = curve_figure([0, 1, 2], {"a": [0.0, 1.0, 0.5]}, x_label="frame", y_label="cm")
    picture = curves.figure_picture(figure)
    stored = encode_palette(picture)
    assert len(stored) < 0.5 * len(encode_png(picture))
    difference = np.abs(decoded(stored).astype(int) - picture.astype(int))
    assert difference.max() <= 24
    assert data_uri(picture, "graph").startswith("data:image/png;base64,")
