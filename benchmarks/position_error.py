"""Distance between the position estimated from the mask and the simulator's own, over random poses of Reacher.

    python benchmarks/position_error.py [--poses 1000] [--image-size 64]

Both joint angles are uniform over their whole range, as at the start of an episode. Poses in which the finger tip is
hidden are counted, and left out of the error.
"""

from __future__ import annotations

import argparse

import numpy as np

from torchrl_ocwm.envs import Reacher


def position_errors(poses: int, *, image_size: int = 64, seed: int = 0) -> np.ndarray:
    """Distances ``[poses]`` in millimetres; NaN where the finger tip is hidden."""
    env = Reacher(image_size=image_size)
    errors = np.full(poses, np.nan)
    for pose in range(poses):
        observation, _ = env.reset(seed=seed if pose == 0 else None)
        if observation["object_visible"][0]:
            difference = observation["object_position"][0] - observation["object_position_true"][0]
            errors[pose] = 1000 * np.linalg.norm(difference)
    env.close()
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    errors = position_errors(arguments.poses, image_size=arguments.image_size, seed=arguments.seed)
    seen = errors[~np.isnan(errors)]
    print(f"Reacher, {arguments.image_size} x {arguments.image_size}, {arguments.poses} random poses")
    print(f"finger tip hidden: {len(errors) - len(seen)} poses")
    print(f"error: median {np.median(seen):.2f} mm, 95th percentile {np.percentile(seen, 95):.2f} mm", end="")
    print(f", largest {seen.max():.2f} mm")


if __name__ == "__main__":
    main()
