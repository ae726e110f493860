"""What holds for every format: whole or not there, sizes, bad frames, the command line."""

import json

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.cli import main
from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, convert
from gsfusion_nb.recordings.convert.conversion import Conversion
from gsfusion_nb.recordings.convert.focal_length import estimated_model
from gsfusion_nb.recordings.convert.recording import OptionNeeded
from gsfusion_nb.types import Camera


@pytest.fixture
def scan(tmp_path, takes):
    """An Open3D recording, the simplest format."""
    root = tmp_path / "scan"
    for i in range(4):
        takes.write(root / f"color/{i}.png", takes.png(i))
        takes.write(root / f"depth/{i}.png", takes.depth_png(i))
    blocks = [
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(repr, r)) for r in takes.T_WC[i].tolist())
        for i in range(4)
    ]
    (root / "trajectory.log").write_text("\n".join([*blocks, ""]))
    c = takes.camera
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx - 0.5, c.cy - 0.5, 1]
    (root / "camera_intrinsic.json").write_text(
        json.dumps({"width": c.width, "height": c.height, "intrinsic_matrix": K})
    )
    return root


def test_the_result_appears_whole_or_not_at_all(tmp_path, takes, scan, monkeypatch):
    add = Conversion.add

    def stop_after_two(self, place, frame):
        if len(self._times) == 2:
            raise KeyboardInterrupt
        add(self, place, frame)

    before = sorted(tmp_path.iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(Conversion, "add", stop_after_two)
        with pytest.raises(KeyboardInterrupt):
            convert(scan, tmp_path / "out")
    assert sorted(tmp_path.iterdir()) == before
    takes.write(tmp_path / ".out.partial/rgb/000009.png", b"of a program that was killed")
    convert(scan, tmp_path / "out")
    takes.check(tmp_path / "out")
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"rgb", "depth", "poses.txt", "intrinsics.json", "times.txt", "conversion.json"}
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "out"])


def test_bad_frames_are_left_out_and_named(tmp_path, takes, scan):
    whole = (scan / "depth/1.png").read_bytes()
    (scan / "depth/1.png").write_bytes(whole[: len(whole) // 2])
    takes.write(
        scan / "depth/2.png",
        type(takes)(takes.camera, [], [np.zeros((44, 60))], takes.T_WC, []).depth_png(0),
    )
    text = (scan / "trajectory.log").read_text().splitlines()
    text[1] = " ".join(str(2 * float(w)) for w in text[1].split())
    (scan / "trajectory.log").write_text("\n".join(text))
    report = convert(scan, tmp_path / "out")
    takes.check(tmp_path / "out", (3,))
    assert report.dropped == {"pose is not rigid": 1, "image missing or damaged": 1, "no depth": 1}
    assert "0.png" in report.examples[0]
    assert "1.png" in report.examples[1]


def test_no_usable_frame_is_an_error(tmp_path, scan):
    for i in range(4):
        (scan / f"color/{i}.png").write_bytes(b"GIF89a")
    with pytest.raises(
        SequenceError,
        match=r"no frame can be used \(4 left out: image missing or damaged; .*0\.png",
    ):
        convert(scan, tmp_path / "out")
    assert not (tmp_path / ".out.partial").exists()


def test_smaller_images(tmp_path, takes, scan):
    convert(scan, tmp_path / "out", options=ConvertOptions(width=30))
    sequence = folder(tmp_path / "out")
    assert vars(sequence.camera) == pytest.approx(vars(takes.camera.resized(30, 22)))
    mean = takes.rgb[1].reshape(22, 2, 30, 2, 3).mean((1, 3))
    assert np.abs(sequence[1].rgb_u8.numpy() - mean).max() <= 1
    assert np.abs(sequence[1].depth_m.numpy() - takes.depth_m[1][::2, ::2]).max() < 6e-4


def test_colour_far_finer_than_depth_is_written_smaller_and_a_note_says_so(tmp_path, takes, scan):
    c = takes.camera.resized(1200, 880)
    for i in range(4):
        large = cv2.resize(
            takes.rgb[i],
            (1200, 880),
            interpolation=cv2.INTER_NEAREST,
        )
        cv2.imwrite(str(scan / f"color/{i}.png"), large[..., ::-1])
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx - 0.5, c.cy - 0.5, 1]
    (scan / "camera_intrinsic.json").write_text(
        json.dumps({"width": 1200, "height": 880, "intrinsic_matrix": K})
    )
    report = convert(scan, tmp_path / "out")
    assert (report.camera.width, report.camera.height) == (640, 469)
    assert "colour is 1200x880, depth 60x44: written with 640 pixels" in str(report)
    assert convert(scan, tmp_path / "all", options=ConvertOptions(width=1200)).camera.width == 1200


def test_scale_and_every(tmp_path, takes, scan):
    report = convert(scan, tmp_path / "out", options=ConvertOptions(scale=2.0, every=2))
    doubled = takes.T_WC.clone()
    doubled[:, :3, 3] *= 2
    type(takes)(
        takes.camera,
        takes.rgb,
        takes.depth_m,
        doubled,
        takes.times_s,
    ).check(tmp_path / "out", (0, 2))
    assert (report.frames, report.frames_read) == (2, 2)


def test_depth_beyond_16_bits_counts_as_missing(tmp_path, takes, scan):
    report = convert(scan, tmp_path / "out", options=ConvertOptions(depth_scale=50.0))
    assert "pixels beyond 65.5 m, the limit of 16-bit depth, were set to missing" in str(report)


@pytest.mark.parametrize(
    "text", ["{fx} {fy} {cx} {cy}", "{fx},{fy},{cx},{cy} 0 0 0 0", "file", "matrix", "json"]
)
def test_intrinsics_of_the_user(tmp_path, takes, scan, text):
    (scan / "camera_intrinsic.json").unlink()
    c = takes.camera
    values = {"fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5}
    file = tmp_path / ("K.json" if text == "json" else "K.txt")
    if text == "matrix":
        file.write_text(f"[[{c.fx}, 0, {c.cx - 0.5}],\n [0, {c.fy}, {c.cy - 0.5}],\n [0, 0, 1]]")
    elif text == "json":
        file.write_text(json.dumps(values))
    else:
        file.write_text("# fx fy cx cy\n{fx} {fy} {cx} {cy}".format(**values))
    given = text.format(**values) if "{" in text else str(file)
    convert(scan, tmp_path / "out", options=ConvertOptions(intrinsics=given))
    takes.check(tmp_path / "out")


def test_other_proportions_are_refused(tmp_path, takes, scan):
    (scan / "camera_intrinsic.json").write_text(
        '{"width": 640, "height": 360, "intrinsic_matrix": [500, 0, 0, 0, 500, 0, 320, 180, 1]}'
    )
    with pytest.raises(
        SequenceError, match=r"0\.png is 60x44, but its camera is 640x360, of other proportions"
    ):
        convert(scan, tmp_path / "out")


@pytest.fixture
def unregistered(tmp_path, takes, scan, box):
    """The scan with depth of a square camera 30 mm beside colour, and that camera's file of a
    transform."""
    depth_camera = Camera(
        width=40,
        height=40,
        fx=25.0,
        fy=25.0,
        cx=20.5,
        cy=19.5,
    )
    T_colour_depth = se3.exp(torch.tensor([0.03, 0.0, 0.0, 0.0, 0.02, 0.0], dtype=torch.float64))
    for i, T in enumerate(box.poses(4)):
        rgb = cv2.imencode(
            ".png",
            box.render(T, takes.camera)[0][..., ::-1],
        )[1].tobytes()
        takes.write(scan / f"color/{i}.png", rgb)
        depth_m = box.render(T @ T_colour_depth, depth_camera)[1]
        depth = cv2.imencode(".png", np.rint(1000 * depth_m).astype(np.uint16))[1].tobytes()
        takes.write(scan / f"depth/{i}.png", depth)
    blocks = [
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(repr, r)) for r in T.tolist())
        for i, T in enumerate(box.poses(4))
    ]
    (scan / "trajectory.log").write_text("\n".join([*blocks, ""]))
    transform = tmp_path / "T.txt"
    transform.write_text(" ".join(map(repr, T_colour_depth.flatten().tolist())))
    return scan, depth_camera, transform


def test_depth_of_other_proportions_is_not_stretched_but_asked_for(tmp_path, unregistered):
    scan, _, _ = unregistered
    with pytest.raises(
        OptionNeeded, match=r"depth is 40x40 and colour 60x44, .*--depth-intrinsics"
    ) as asked:
        convert(scan, tmp_path / "out")
    assert asked.value.option == "depth_intrinsics"
    assert not (tmp_path / "out").exists()
    pairs = [(scan / f"color/{i}.png", scan / f"depth/{i}.png") for i in range(4)] * 2
    with pytest.raises(
        SequenceError, match=r"depth/.\.png is 40x40 and .* 60x44, of other proportions"
    ):
        estimated_model(pairs, 1000.0)


def test_depth_of_another_camera_is_registered_with_its_intrinsics_and_place(
    tmp_path, unregistered, box
):
    scan, c, transform = unregistered
    given = ConvertOptions(
        depth_intrinsics=f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}", T_colour_depth=str(transform)
    )
    convert(scan, tmp_path / "out", options=given)
    for frame in folder(tmp_path / "out"):
        assert float((frame.depth_m > 0).float().mean()) > 0.95
        assert box.off_wall_m(frame) < 0.02
    with pytest.raises(SequenceError, match="not both"):
        ConvertOptions(depth_intrinsics="colour", T_colour_depth=str(transform))


def test_depth_said_to_be_registered_keeps_its_proportions_too(tmp_path, unregistered):
    with pytest.raises(SequenceError, match="other proportions"):
        convert(
            unregistered[0], tmp_path / "out", options=ConvertOptions(depth_intrinsics="colour")
        )


def test_command(tmp_path, takes, scan, capsys):
    assert main(["convert", "open3d", str(scan), str(tmp_path / "out")]) == 0
    takes.check(tmp_path / "out")
    assert capsys.readouterr().out.splitlines()[-1] == f"Next: gsfusion-nb check {tmp_path / 'out'}"
    assert (
        main(
            [
                "convert",
                str(scan),
                str(tmp_path / "small"),
                "--width",
                "30",
                "--depth-scale",
                "1000",
            ]
        )
        == 0
    )
    assert folder(tmp_path / "small").camera.width == 30
    assert main(["convert", str(scan)]) == 1
    assert "expected [FORMAT] SOURCE OUT; the formats" in capsys.readouterr().err
    assert main(["convert", str(scan), str(tmp_path / "out")]) == 1
    assert "already exists" in capsys.readouterr().err
