"""Further images of a frame: from a function or a reader, resized with it, seen by rules, part of
the key."""

import dataclasses

import numpy as np
import pytest
import torch

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data.adjust.selection import apply_options
from gsfusion_nb.seeding import SeedContext, apply_rule, check_rule
from gsfusion_nb.types import Camera, Frame

WIDTH = 8
HEIGHT = 6
CAMERA = Camera(
    width=WIDTH,
    height=HEIGHT,
    fx=8.0,
    fy=8.0,
    cx=4.0,
    cy=3.0,
)


class Plain:
    """A sequence in memory; its frames have an extra image of the reader."""

    name = "plain"
    camera = CAMERA

    def __len__(self):
        return 4

    def pose(self, i):
        return torch.eye(4)

    def __getitem__(self, i):
        depth_m = torch.full((HEIGHT, WIDTH), 2.0)
        rgb = torch.rand(
            HEIGHT,
            WIDTH,
            3,
            generator=torch.Generator().manual_seed(i),
        )
        extra = {"sigma": torch.arange(HEIGHT * WIDTH, dtype=torch.float32).reshape(HEIGHT, WIDTH)}
        return Frame(
            index=i,
            timestamp_s=float(i),
            rgb=rgb,
            depth_m=depth_m,
            camera=CAMERA,
            T_WC=torch.eye(4),
            extra=extra,
        )


def labels(frame, value=7):
    image = np.zeros((HEIGHT, WIDTH), np.int64)
    image[:, WIDTH // 2 :] = value
    return {"labels": image, "flow": np.ones((HEIGHT, WIDTH, 2), np.float32)}


def not_labelled(ctx: SeedContext):
    return ctx.seeds_at(ctx.pixels(ctx.frame.extra["labels"] == 0), 1.0)


def test_extra_images_are_resized_with_the_frame():
    frame = apply_options(
        Plain(),
        DataConfig(width=4, height=3),
        labels,
    ).mapping[0]
    assert {name: tuple(image.shape) for name, image in frame.extra.items()} == {
        "sigma": (3, 4),
        "labels": (3, 4),
        "flow": (3, 4, 2),
    }
    assert frame.extra["labels"].dtype == torch.int64
    assert frame.extra["labels"].tolist() == [[0, 0, 7, 7]] * 3  # no class between two classes
    assert frame.extra["sigma"][0].tolist() == [0, 2, 4, 6]  # of the nearest pixels
    whole = apply_options(Plain(), DataConfig(), labels).mapping[0]
    assert torch.equal(whole.extra["labels"], torch.from_numpy(labels(whole)["labels"]))
    assert dataclasses.replace(whole, index=3).to("cpu").extra["labels"] is whole.extra["labels"]


def test_a_rule_sees_labels_and_drops_a_class():
    frame = apply_options(Plain(), DataConfig(), labels).mapping[0]
    seeds = apply_rule(not_labelled, SeedContext(frame))
    assert len(seeds) == HEIGHT * WIDTH // 2
    assert bool((seeds.xyz_W[:, 0] < 0).all())
    with pytest.raises(KeyError, match=r"labels.*sigma"):
        apply_rule(not_labelled, SeedContext(Plain()[0]))
    check_rule(
        not_labelled,
        extra=lambda frame: {"labels": (frame.rgb[..., 0] > 0.5).int()},
    )


@pytest.mark.parametrize(
    "bad",
    [np.zeros((3, 3)), np.full((HEIGHT, WIDTH), np.nan)],
)
def test_a_bad_extra_image_is_refused_with_its_name(bad):
    with pytest.raises(ValueError, match="labels"):
        _ = apply_options(
            Plain(),
            DataConfig(),
            lambda frame: {"labels": bad},
        ).mapping[0]
