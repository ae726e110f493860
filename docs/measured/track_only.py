"""ATE of a tracker against a TSDF without Gaussians:
``python docs/measured/track_only.py FOLDER``."""

import dataclasses
import json
import sys

import torch

from gsfusion_nb.config import DataConfig, TrackingConfig, gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.tracking import Tracker, tsdf_surface
from gsfusion_nb.tsdf import TsdfVolume, integrate

sequence = open_sequence(
    sys.argv[1],
    data=DataConfig(width=320, height=240, hold_out_every=8),
)
found = {}
for name, brightness_m in (("depth", None), ("both", TrackingConfig().brightness_m)):
    tracker = Tracker(TrackingConfig(poses="tracked", brightness_m=brightness_m))
    volume = TsdfVolume(gsfusion("replica").tsdf)
    poses = []
    true = []
    for i in range(len(sequence.mapping)):
        frame = sequence.mapping[i]
        poses.append(tracker.track(frame, tsdf_surface(volume)).T_WC)
        true.append(frame.T_WC)
        integrate(volume, dataclasses.replace(frame, T_WC=poses[-1]))
    found[name] = {
        "ate_rmse_m": ate_rmse(torch.stack(poses), torch.stack(true)),
        "n_frames": len(poses),
    }
print(json.dumps(found))  # noqa: T201
