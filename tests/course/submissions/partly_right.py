import torch


def signed_distance(depth_m, z_m, truncation_m):
    sdf_m = depth_m - z_m
    observed = (depth_m > 0) & (sdf_m > -truncation_m)
    return (sdf_m / truncation_m).clamp(-1, 1), observed


def running_average(D, W, d, max_weight):
    W_new = (W + 1).clamp(max=max_weight)
    return (D * (W_new - 1) + d) / W_new, W_new


def block_of(xyz_W, voxel_size_m):
    return torch.floor(xyz_W / (8 * voxel_size_m)).long()


def morton_code(x, y, z): ...


def zero_crossing(p0, p1, D0, D1):
    return (p0 + p1) / 2
