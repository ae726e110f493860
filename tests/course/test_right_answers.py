"""Right answers in another style than the notebooks' solutions: loops, NumPy, float64, lists.
Judges accept them."""

import math

import numpy as np
import pytest
import torch

from gsfusion_nb.course import exercises

ALL = exercises()


def first_seen(weight, depth_m):
    return [float(w) == 1 and float(d) > 0 for w, d in zip(weight, depth_m, strict=True)]


def psnr(rendered, photo):
    return 20 * math.log10(1 / math.sqrt(np.mean((rendered.numpy() - photo.numpy()) ** 2)))


def exam_frames(n, every, offset):
    return np.arange(offset, n, every)


def lift_pixels(camera, uv, depth_m):
    rows = [
        ((u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z)
        for (u, v), z in zip(uv, depth_m, strict=True)
    ]
    return np.array(rows, dtype=np.float64)


def normals_of_points(points):
    p = points.double().numpy()
    n = np.cross(
        p[2:, 1:-1] - p[:-2, 1:-1],
        p[1:-1, 2:] - p[1:-1, :-2],
    )
    return n / np.sqrt((n**2).sum(-1, keepdims=True))


def halve_intrinsics(fx, fy, cx, cy):
    return np.array([fx * 0.5, fy * 0.5, cx / 2 - 0.25, cy / 2 - 0.25]).tolist()


def signed_distance(depth_m, z_m, truncation_m):
    d = []
    observed = []
    for depth, z in zip(depth_m.tolist(), z_m.tolist(), strict=True):
        d.append(max(-1.0, min(1.0, (depth - z) / truncation_m)))
        observed.append(depth > 0 and z < depth + truncation_m)
    return np.array(d), np.array(observed)


def running_average(D, W, d, max_weight):
    W_new = torch.minimum(W + 1, torch.full_like(W, max_weight))
    return D + (d - D) / W_new, W_new


def block_of(xyz_W, voxel_size_m):
    return np.floor(xyz_W.numpy() / (8 * voxel_size_m)).astype(np.int32)


def morton_code(x, y, z):
    bits = [f"{c:010b}" for c in (z, y, x)]
    return int(
        "".join("".join(three) for three in zip(*bits, strict=True)),
        2,
    )


def contrast(cell_rgb, image_pixels):
    c = cell_rgb.numpy().astype(float).reshape(-1, 3)
    return float(c.var(axis=0) @ [0.2989, 0.5870, 0.1140]) * image_pixels / 9e7


def split_cell(x0, y0, width, height):
    xs = (x0, x0 + width // 2, x0 + width)
    ys = (y0, y0 + height // 2, y0 + height)
    return np.array(
        [(xs[i], ys[j], xs[i + 1] - xs[i], ys[j + 1] - ys[j]) for i in (0, 1) for j in (0, 1)]
    )


def quadtree_leaves(rgb_u8, threshold, min_cell_px):
    H, W = rgb_u8.shape[:2]
    leaves = []
    waiting = [(0, 0, W, H)]
    while waiting:
        x, y, w, h = cell = waiting.pop()
        if (
            min(w // 2, h // 2) > min_cell_px
            and contrast(rgb_u8[y : y + h, x : x + w], H * W) > threshold
        ):
            waiting += [tuple(part) for part in split_cell(*cell).tolist()]
        else:
            leaves.append(list(cell))
    return torch.tensor(leaves)


def splat_alpha(dx, dy, conic, opacity):
    A, B, C = conic.tolist()
    alpha = np.minimum(
        float(opacity)
        * np.exp(
            -0.5 * (A * dx.numpy() ** 2 + 2 * B * dx.numpy() * dy.numpy() + C * dy.numpy() ** 2)
        ),
        0.99,
    )
    alpha[alpha < 1 / 255] = 0
    return alpha


def slope(loss, x, h):
    steps = h * torch.eye(len(x), dtype=x.dtype)
    return [float(loss(x + e) - loss(x - e)) / (2 * h) for e in steps]


def blend_vjp(alpha, rgb, v_colour):
    n = len(alpha)
    v_alpha = torch.zeros_like(alpha)
    v_rgb = torch.zeros_like(rgb)
    for k in range(n):
        T = torch.prod(1 - alpha[:k])
        v_rgb[k] = alpha[k] * T * v_colour
        v_alpha[k] = T * (rgb[k] @ v_colour)
        for j in range(k + 1, n):
            others = torch.prod(torch.cat([1 - alpha[:k], 1 - alpha[k + 1 : j]]))
            v_alpha[k] -= alpha[j] * others * (rgb[j] @ v_colour)
    return v_alpha, v_rgb


def splat_alpha_vjp(dx, dy, conic, opacity, v_alpha):
    A, B, C = conic.tolist()
    v_uv = np.zeros(2)
    v_conic = np.zeros(3)
    v_opacity = 0.0
    for x, y, v in zip(
        dx.tolist(),
        dy.tolist(),
        v_alpha.tolist(),
        strict=True,
    ):
        bell = math.exp(-(A * x * x + C * y * y) / 2 - B * x * y)
        a = float(opacity) * bell
        if 1 / 255 <= a < 0.99:
            v_uv += a * v * np.array([A * x + B * y, B * x + C * y])
            v_conic -= a * v * np.array([x * x / 2, x * y, y * y / 2])
            v_opacity += bell * v
    return v_uv, v_conic, v_opacity


def adam(param, gradient, m, v, t, lr, beta1, beta2, eps):
    m = torch.lerp(gradient, m, beta1)
    v = v + (1 - beta2) * (gradient * gradient - v)
    step = (m / (1 - beta1**t)) / ((v / (1 - beta2**t)) ** 0.5 + eps)
    return param - step * lr, m, v


def frame_rate(seconds):
    return 1 / np.mean(seconds)


def draw_keyframes(n_keyframes, count, generator):
    left = list(range(n_keyframes))
    drawn = []
    while left and len(drawn) < count:
        drawn.append(left.pop(int(torch.randint(len(left), (), generator=generator))))
    return drawn


def fuse(before, after, eta_before, eta_after):
    rows = []
    for b, a, before_n, after_n in zip(
        before, after, eta_before.tolist(), eta_after.tolist(), strict=True
    ):
        rows.append(b if after_n == 0 else (before_n * b + (after_n - before_n) * a) / after_n)
    return torch.stack(rows)


def pareto_rules(n_gaussians, psnr_db):
    rules = list(zip(n_gaussians.tolist(), psnr_db.tolist(), strict=True))
    return [not any(a <= n and b >= db and (a, b) != (n, db) for a, b in rules) for n, db in rules]


def adam_traffic(n):
    return np.int64(7 * 4 * n), np.float32(12 / 28)


def average_loop(D, W, d, max_weight):
    seen = np.isfinite(d) & (d >= -1)
    W_new = np.where(seen, np.minimum(W + 1, max_weight), W)
    return np.where(
        seen,
        D + (np.minimum(np.nan_to_num(d), 1) - D) / np.maximum(W_new, 1),
        D,
    ), W_new


RIGHT = {name: value for name, value in list(globals().items()) if name in ALL and callable(value)}


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_answer_in_another_style_passes(name):
    verdict = ALL[name](RIGHT[name])
    assert verdict, repr(verdict)
