"""Distance between the position estimated from the mask and the simulator's own.

    python benchmarks/position_error.py [--env reacher] [--poses 1000] [--episodes 10] [--mask-scales 1 2 4]
        [--image-size 64] [--labelled-frames 0]

Measured twice. Poses are those of goal observations, the first object uniform in the workspace. Carried: an episode to
each of the first landmarks, 60 steps of the environment's scripted policy. "hidden" is the share of frames in which the
object has no pixel; they are left out of the error. The cost is that of an observation, the scales taking turns.
With --labelled-frames objects are found by colours that are learnt from so many frames.
"""

from __future__ import annotations

import argparse
import time

import gymnasium
import numpy as np

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv

STEPS = 60


def millimetres(observation: dict[str, np.ndarray]) -> float:
    """How far the first object is from where it seems to be; NaN if it is hidden."""
    if not observation["object_visible"][0]:
        return np.nan
    return 1000 * float(np.linalg.norm(observation["object_position"][0] - observation["object_position_true"][0]))


def of_poses(env: PositioningEnv, poses: int, seed: int) -> np.ndarray:
    """``[poses]`` errors of goal observations."""
    env.reset(seed=seed)
    goals = np.random.default_rng(seed).uniform(env.workspace.low, env.workspace.high, (poses, env.workspace.dim))
    return np.array([millimetres(env.goal_observation(goal)) for goal in goals])


def of_carrying(env: PositioningEnv, episodes: int, seed: int) -> np.ndarray:
    """``[episodes * STEPS]`` errors while the scripted policy is at work."""
    errors = []
    for number, landmark in enumerate(env.workspace.landmarks[:episodes]):
        env.reset(seed=seed + number, options={"goal_position": landmark})
        errors += [millimetres(env.step(env.scripted_action())[0]) for _ in range(STEPS)]
    return np.array(errors)


def costs(envs: list[PositioningEnv], rounds: int = 200) -> np.ndarray:
    """``[S]`` milliseconds of an observation, medians."""
    times = np.empty((rounds, len(envs)))
    for row in times:
        for column, env in enumerate(envs):
            start = time.perf_counter()
            env.render()
            row[column] = 1000 * (time.perf_counter() - start)
    return np.median(times, axis=0)


def cells(errors: np.ndarray) -> list[str]:
    """Share hidden, median and 95th percentile."""
    hidden, seen = np.isnan(errors).mean(), errors[~np.isnan(errors)]
    return [f"{hidden:.1%}", f"{np.median(seen):.2f}", f"{np.percentile(seen, 95):.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="reacher")
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--mask-scales", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--labelled-frames", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    size, seed = arguments.image_size, arguments.seed
    common = {
        "image_size": size,
        "labelled_frames": arguments.labelled_frames,
        "horizon": 10**9,
        "render_mode": "rgb_array",
    }
    envs = [
        gymnasium.make(ENVIRONMENTS[arguments.env].id, mask_scale=scale, privileged=True, **common).unwrapped
        for scale in arguments.mask_scales
    ]
    numbers = f"{arguments.poses} poses, {arguments.episodes} episodes"
    print(f"{arguments.env}, images of {size} x {size}, {numbers}; errors in mm\n")
    head = [
        "segmentation",
        *(f"{what}: {name}" for what in ("poses", "carried") for name in ("hidden", "median", "95 %")),
    ]
    print(f"| {' | '.join([*head, 'observation, ms'])} |\n|---|{'---:|' * len(head)}")
    errors = [
        cells(of_poses(env, arguments.poses, seed)) + cells(of_carrying(env, arguments.episodes, seed)) for env in envs
    ]
    for env, row, cost in zip(envs, errors, costs(envs), strict=True):
        fine = env.mask_scale * size
        print(f"| {' | '.join([f'{fine} x {fine}', *row, f'{cost:.2f}'])} |")
        env.close()


if __name__ == "__main__":
    main()
