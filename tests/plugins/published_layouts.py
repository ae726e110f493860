"""The layouts of published data sets, written with views of the box room."""

import json

import numpy as np

from gsfusion_nb.data.readers.seven_scenes import COLOUR_LENS, DEPTH_CAMERA, T_DEPTH_COLOUR
from gsfusion_nb.geometry import quaternion

TUM_START_S = 1305031102.0


def tum_layout(
    root,
    box,
    *,
    n=4,
    rgb_lag=0.012,
    gt_step=0.01,
    gt_end=1.0,
    camera=None,
    camera_scale=5000,
):
    """The public layout: three lists with comments, images named by their time stamps."""
    rgb_lines = ["# color images", "# timestamp filename"]
    depth_lines = ["# depth maps"]
    gt_lines = ["# ground truth"]
    for i in range(n):
        t_depth = 0.1 + i / 30
        t_rgb = t_depth + rgb_lag
        box.write_pair(
            root / f"rgb/{TUM_START_S + t_rgb:.6f}.png",
            root / f"depth/{TUM_START_S + t_depth:.6f}.png",
            box.pose_at(t_depth),
            camera_scale,
            camera,
        )
        rgb_lines.append(f"{TUM_START_S + t_rgb:.6f} rgb/{TUM_START_S + t_rgb:.6f}.png")
        depth_lines.append(f"{TUM_START_S + t_depth:.6f} depth/{TUM_START_S + t_depth:.6f}.png")
    for k in range(int(gt_end / gt_step)):
        T = box.pose_at(k * gt_step + 0.003)
        w, x, y, z = quaternion.from_matrix(T[:3, :3]).tolist()
        values = [*T[:3, 3].tolist(), x, y, z, w]
        gt_lines.append(
            f"{TUM_START_S + k * gt_step + 0.003:.4f} " + " ".join(f"{v:.9f}" for v in values)
        )
    for name, lines in (("rgb", rgb_lines), ("depth", depth_lines), ("groundtruth", gt_lines)):
        (root / f"{name}.txt").write_text("\n".join([*lines, ""]))
    return root


TRAIN = ["DSC00003.JPG", "DSC00001.JPG", "DSC00002.JPG"]  # the lists' order, not the alphabet's
TEST = ["DSC00005.JPG"]


def scannetpp_layout(root, box, suffix="_2", **changes):
    """The public layout. The world of the JSON is any world: here the box's own."""
    dslr = root / "dslr"
    c = box.camera
    frames = {}
    for name in [*TRAIN, *TEST]:
        T = box.poses(6)[int(name[3:8])]
        box.write_pair(
            dslr / f"undistorted_images{suffix}" / name,
            dslr / f"undistorted_depths{suffix}" / name.replace("JPG", "png"),
            T,
            1000,
        )
        gl = T.numpy() @ np.diag([1.0, -1, -1, 1])
        frames[name] = {"file_path": name, "transform_matrix": gl.tolist(), "is_bad": False}
    values = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    values |= {"camera_model": "PINHOLE", "k1": 0.0}
    values |= {
        "frames": [frames[n] for n in sorted(TRAIN)],
        "test_frames": [frames[n] for n in TEST],
    }
    (dslr / "nerfstudio").mkdir(exist_ok=True)
    values = {k: v for k, v in (values | changes).items() if v is not None}
    (dslr / f"nerfstudio/transforms_undistorted{suffix}.json").write_text(json.dumps(values))
    (dslr / "train_test_lists.json").write_text(
        json.dumps({"train": TRAIN, "test": TEST, "has_masks": False})
    )
    return root


def seven_scenes_layout(root, box, n=2):
    """The public layout: colour from the colour camera, depth and pose of the depth camera."""
    for i in range(n):
        T = box.poses(n)[i]
        _, depth_m = box.render(T, DEPTH_CAMERA)
        rgb, _ = box.render(T @ T_DEPTH_COLOUR, COLOUR_LENS.camera)
        depth_m[:9] = 65.535  # the invalid value
        depth_m[9] = 0
        box.write_rgb(root / f"frame-{i:06d}.color.png", rgb)
        box.write_depth(root / f"frame-{i:06d}.depth.png", depth_m, 1000)
        lines = ["\t ".join(f"{v: .7e}" for v in row) + "\t " for row in T.tolist()]
        (root / f"frame-{i:06d}.pose.txt").write_text("\n".join(lines) + "\n")
    return root
