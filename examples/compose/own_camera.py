"""From masks to positions with a camera of your own: ``python examples/compose/own_camera.py``.

``MaskToPosition`` needs the camera's intrinsics and pose, a mask of each object, and either depth images or the plane
that the objects move on. It is a TorchRL transform: call it on recorded frames as below, append it to an environment,
or give it to a replay buffer.

The frames are synthetic, so that the true positions are known: a puck slides over a table under a camera that looks
down at an angle. A share of the depth pixels has no reading, as with real sensors, and in some frames something hides
the puck, which then keeps the position where it was last seen.
"""

from __future__ import annotations

import argparse
import math

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.envs import MaskToPosition

# Pixels: focal lengths and the point where the optical axis meets the image.
HEIGHT, WIDTH = 120, 160
INTRINSICS = torch.tensor([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])
RADIUS = 0.03  # of the puck, metres


def camera_pose(position: tuple[float, float, float], target: tuple[float, float, float]) -> Tensor:
    """Camera-to-world matrix ``[4, 4]`` of a camera that looks at a point: x right, y down, z into the scene."""
    origin = torch.tensor(position)
    forward = torch.nn.functional.normalize(torch.tensor(target) - origin, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    pose = torch.eye(4)
    pose[:3] = torch.stack([right, torch.linalg.cross(forward, right), forward, origin], -1)
    return pose


def record(pose: Tensor, frames: int, holes: float) -> tuple[TensorDict, Tensor]:
    """Frames ``[T]`` with mask and depth of a puck on the table z = 0, and its true positions ``[T, 3]`` in metres."""
    angle = torch.linspace(0, 2 * math.pi, frames)
    truth = torch.stack([0.2 * angle.cos(), 0.15 * (2 * angle).sin(), torch.zeros(frames)], -1)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1)
    rays = pixels @ torch.linalg.inv(INTRINSICS).mT @ pose[:3, :3].mT  # one metre along the optical axis
    depth = -pose[2, 3] / rays[..., 2]  # where they meet the table
    table = pose[:3, 3] + rays * depth[..., None]
    masks = (table - truth[:, None, None]).norm(dim=-1) < RADIUS
    masks[frames // 3 : frames // 2] = False  # hidden
    depth = torch.where(torch.rand(frames, 1, HEIGHT, WIDTH) < holes, 0.0, depth)
    return TensorDict({"masks": masks.unsqueeze(1), "depth": depth}, [frames]), truth


def main(frames: int = 60, holes: float = 0.1, seed: int = 0) -> dict[str, float]:
    torch.manual_seed(seed)
    pose = camera_pose((0.0, -0.6, 0.6), (0.0, 0.0, 0.0))
    data, truth = record(pose, frames, holes)
    errors = {}
    for name, surface in {"depth": {"depth": "depth"}, "plane": {"plane": (0.0, 0.0, 1.0, 0.0)}}.items():
        found = MaskToPosition(INTRINSICS, pose, **surface)(data.clone())  # type: ignore[arg-type]
        seen, position = found["object_visible"][:, 0], found["object_position"][:, 0]
        error = (position - truth).norm(dim=-1)[seen]
        errors[name] = float(error.max())
        print(
            f"with {name}: {int(seen.sum())} of {frames} frames show the puck; error of its position: "
            f"{1000 * error.mean():.1f} mm on average, {1000 * error.max():.1f} mm at most"
        )
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--holes", type=float, default=0.1, help="share of the depth pixels without a reading")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
