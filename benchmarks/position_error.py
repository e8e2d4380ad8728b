"""Distance between the position estimated from the mask and the simulator's own, over random poses of an environment.

    python benchmarks/position_error.py [--env reacher] [--poses 1000] [--mask-scales 1 2 4] [--image-size 64]

A pose is that of a goal observation: the first object uniform in the workspace. Poses in which it is hidden are
counted, and left out of the error. The cost is that of an observation, in milliseconds, with the scales taking turns.
"""

from __future__ import annotations

import argparse
import time

import gymnasium
import numpy as np

import torchrl_ocwm.envs  # noqa: F401  (registers the ids)
from torchrl_ocwm.envs import ENVIRONMENTS


def millimetres(observation: dict[str, np.ndarray]) -> float:
    """How far the first object is from where it seems to be; NaN if it is hidden."""
    if not observation["object_visible"][0]:
        return np.nan
    return 1000 * float(np.linalg.norm(observation["object_position"][0] - observation["object_position_true"][0]))


def measure(name: str, scales: list[int], poses: int, image_size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors in millimetres, NaN where the object is hidden, and milliseconds of each observation, ``[S, poses]``."""
    envs = [
        gymnasium.make(ENVIRONMENTS[name].id, image_size=image_size, mask_scale=scale).unwrapped for scale in scales
    ]
    for env in envs:
        env.reset(seed=seed)
    goals = np.random.default_rng(seed).uniform(envs[0].workspace.low, envs[0].workspace.high, (poses, 2))
    errors, cost = np.empty((len(scales), poses)), np.empty((len(scales), poses))
    for pose, goal in enumerate(goals):
        for row, env in enumerate(envs):
            start = time.perf_counter()
            observation = env.goal_observation(goal)
            cost[row, pose] = 1000 * (time.perf_counter() - start)
            errors[row, pose] = millimetres(observation)
    for env in envs:
        env.close()
    return errors, cost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="reacher")
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--mask-scales", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    scales, size = arguments.mask_scales, arguments.image_size
    print(f"{arguments.env}, images of {size} x {size}, {arguments.poses} random poses\n")
    print("| segmentation | hidden | median error, mm | 95th percentile | largest | observation, ms |")
    print("|---|---:|---:|---:|---:|---:|")
    for scale, errors, cost in zip(
        scales, *measure(arguments.env, scales, arguments.poses, size, arguments.seed), strict=True
    ):
        seen = errors[~np.isnan(errors)]
        numbers = (np.median(seen), np.percentile(seen, 95), seen.max(), np.median(cost))
        cells = [
            f"{scale * size} x {scale * size}",
            str(len(errors) - len(seen)),
            *(f"{number:.2f}" for number in numbers),
        ]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
