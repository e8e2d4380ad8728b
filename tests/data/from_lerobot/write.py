"""Writes ``v3``, with LeRobot and nothing of this package: ``python tests/data/from_lerobot/write.py``."""

from pathlib import Path

import numpy as np

if __name__ == "__main__":
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    camera = {"dtype": "video", "shape": (32, 48, 3), "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": (3,), "names": None}
    cameras = ("observation.images.top", "observation.images.wrist")
    features = {**dict.fromkeys(cameras, camera), "observation.state": vector, "action": vector}
    dataset = LeRobotDataset.create("so/arm", 10, features, root=Path(__file__).parent / "v3", use_videos=True)
    for episode, frames in enumerate((6, 7)):
        for frame in range(frames):
            bright = np.full(camera["shape"], 10 * (episode + frame), np.uint8)
            joints = np.full(vector["shape"], frame, np.float32)
            pictures = dict(zip(cameras, (bright, 255 - bright), strict=True))
            dataset.add_frame({**pictures, "observation.state": joints, "action": 100 * episode + joints, "task": "x"})
        dataset.save_episode()
    dataset.finalize()
