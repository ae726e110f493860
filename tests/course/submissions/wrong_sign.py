import torch


def signed_distance(depth_m, z_m, truncation_m):
    return ((z_m - depth_m) / truncation_m).clamp(-1, 1), depth_m > 0


def running_average(D, W, d, max_weight):
    return (D + d) / 2, W + 1


def block_of(xyz_W, voxel_size_m):
    return torch.floor(xyz_W / voxel_size_m).long()


def morton_code(x, y, z):
    return x + 1024 * y + 1024**2 * z


def zero_crossing(p0, p1, D0, D1):
    return p0 + (D1 / (D0 - D1))[:, None] * (p1 - p0)
