"""Settings of each system with which it maps a few small frames of the room in a second."""

from typing import Any

from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam

_SMALL: dict[str, Any] = {"data__width": 40, "data__height": 30, "data__stop": 8}
CONFIGS = {
    "gsfusion": gsfusion(
        "room", tsdf__voxel_size_m=0.05, seeding__quadtree_threshold=0.002, **_SMALL
    ),
    "rtg_slam": rtg_slam("room", **_SMALL),
    "gps_slam": gps_slam(
        "room", data__width=64, data__height=48, data__stop=16, tsdf__voxel_size_m=0.04
    ),
}
