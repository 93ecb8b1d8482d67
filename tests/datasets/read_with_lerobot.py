"""Reads a data set with LeRobot's own loader; `make test-lerobot` calls it where LeRobot is installed, without gym_mara."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import dataset_to_policy_features

folder = Path(sys.argv[1])
# torchcodec, the default, needs an FFmpeg of the system.
data = LeRobotDataset("gym_mara/own", root=folder, video_backend="pyav")
info = json.loads((folder / "meta" / "info.json").read_text())
assert (data.num_episodes, data.num_frames, data.fps) == (
    info["total_episodes"],
    info["total_frames"],
    info["fps"],
)
table = pyarrow.parquet.read_table(folder / "data").to_pylist()
features = dataset_to_policy_features(data.features)
assert features["action"].shape == (len(table[0]["action"]),)
for index in (0, data.num_frames // 2, data.num_frames - 1):
    frame = data[index]
    for key in ("observation.state", "action"):
        np.testing.assert_array_equal(frame[key].numpy(), np.float32(table[index][key]))
    assert frame["next.done"].item() == table[index]["next.done"]
    assert frame["task"].startswith("gym_mara/")
    if "observation.images.camera" in data.meta.video_keys:
        height, width, channels = info["features"]["observation.images.camera"]["shape"]
        assert frame["observation.images.camera"].shape == (channels, height, width)
        assert 0.0 < frame["observation.images.camera"].mean() < 1.0
assert data.meta.stats is not None
assert data.meta.stats["action"]["mean"].shape == features["action"].shape
batch = next(iter(torch.utils.data.DataLoader(data, batch_size=4)))
assert batch["action"].shape == (4, *features["action"].shape)
chunked = LeRobotDataset(
    "gym_mara/own",
    root=folder,
    delta_timestamps={"action": [0.0, 1.0 / data.fps]},
    video_backend="pyav",
)
assert chunked[0]["action"].shape == (2, *features["action"].shape)
print(f"LeRobot reads {data.num_episodes} episodes, {data.num_frames} frames")
