"""Environment steps per second beside physics alone, and the minimum: physics, one RGB and one segmentation render.

    MUJOCO_GL=egl python benchmarks/env_speed.py [--env reacher] [--rounds 30] [--steps 200] [--image-size 64]
        [--workers 2]

All take random actions, as what is in the picture has to be drawn. They run in one process, in short turns, so that a
noisy machine slows all. The minimum steps the same simulator and renders with ``mujoco.Renderer`` and the same flags:
no shadows, no reflections, no multisampling. The next row adds TorchRL's wrapper. The last one is a collector, one
process for each environment (0: no such row).
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from itertools import cycle

import gymnasium
import mujoco
import numpy as np
import torch
from torchrl.collectors import MultiSyncCollector

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv, make_env


def make_one(name: str, image_size: int) -> PositioningEnv:
    env = gymnasium.make(ENVIRONMENTS[name].id, image_size=image_size, horizon=10**9).unwrapped
    env.reset(seed=0)
    return env


def make_renderer(env: PositioningEnv) -> mujoco.Renderer:
    env.model.vis.quality.offsamples = 0
    renderer = mujoco.Renderer(env.model, env.image_size, env.image_size)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    return renderer


def random_actions(env: PositioningEnv) -> Iterator[np.ndarray]:
    """The same for every row."""
    return cycle(np.random.default_rng(0).uniform(-1, 1, (1000, *env.action_space.shape)).astype(np.float32))


def physics(env: PositioningEnv) -> Callable[[], None]:
    actions = random_actions(env)

    def step() -> None:
        action = next(actions)
        for _ in range(env.action_repeat):
            env._step_simulator(action)

    return step


def minimum(env: PositioningEnv, renderer: mujoco.Renderer) -> Callable[[], None]:
    """Physics and two renders, and nothing else."""
    move = physics(env)

    def step() -> None:
        move()
        renderer.update_scene(env.data, env.camera_name)
        renderer.render()
        renderer.enable_segmentation_rendering()
        renderer.render()
        renderer.disable_segmentation_rendering()

    return step


def make_collector(name: str, image_size: int, workers: int, steps: int) -> MultiSyncCollector:
    make = partial(make_env, name, image_size=image_size, horizon=10**9)
    return MultiSyncCollector([make] * workers, None, frames_per_batch=workers * steps, total_frames=-1)


def repeat(step: Callable[[], object], steps: int) -> Callable[[], None]:
    def turn() -> None:
        for _ in range(steps):
            step()

    return turn


def seconds(turn: Callable[[], object]) -> float:
    start = time.perf_counter()
    turn()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="reacher")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    name, size, workers = arguments.env, arguments.image_size, arguments.workers
    with ExitStack() as stack:
        moved, by_hand, env = (stack.enter_context(closing(make_one(name, size))) for _ in range(3))
        renderer = stack.enter_context(closing(make_renderer(by_hand)))
        several = f"{workers} processes"
        wrapped = stack.enter_context(closing(make_env(name, image_size=size, horizon=10**9, seed=0)))
        start, actions, same_actions = wrapped.reset(), random_actions(env), random_actions(env)
        turns: dict[str, Callable[[], object]] = {
            "physics": repeat(physics(moved), arguments.steps),
            "minimum": repeat(minimum(by_hand, renderer), arguments.steps),
            "gymnasium environment": repeat(lambda: env.step(next(actions)), arguments.steps),
            "TorchRL environment": repeat(
                lambda: wrapped.step(start.set("action", torch.from_numpy(next(same_actions)))), arguments.steps
            ),
        }
        if workers:
            collector = make_collector(name, size, workers, arguments.steps)
            stack.callback(collector.shutdown)
            turns[several] = partial(next, iter(collector))
        for turn in turns.values():
            turn()
        times: dict[str, list[float]] = {turn: [] for turn in turns}
        for _ in range(arguments.rounds):
            for name_of_turn, turn in turns.items():
                frames = arguments.steps * (workers if name_of_turn == several else 1)
                times[name_of_turn].append(seconds(turn) / frames)

    print(f"{name}, {size} x {size}, median of {arguments.rounds} turns of {arguments.steps} steps")
    print(f"{'':24}{'steps/s':>10}{'of the minimum':>16}")
    for turn, values in times.items():
        ratio = statistics.median(low / value for low, value in zip(times["minimum"], values, strict=True))
        print(f"{turn:24}{1 / statistics.median(values):10.1f}{ratio:16.2f}")


if __name__ == "__main__":
    main()
