"""Environment steps per second beside the bare minimum: physics, one RGB and one segmentation render, by hand.

    python benchmarks/env_speed.py [--rounds 30] [--steps 200] [--image-size 64]

Both run in one process, in short turns, so that a noisy machine slows both. The minimum uses ``mujoco.Renderer`` with
the same flags: no shadows, no reflections, no multisampling. The last row adds TorchRL's wrapper.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import mujoco
import numpy as np
import torch

from torchrl_ocwm.envs import Reacher, make_env


def minimum(env: Reacher, renderer: mujoco.Renderer) -> Callable[[], None]:
    """Physics and two renders of the same model, and nothing else."""
    model, data = env.model, mujoco.MjData(env.model)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

    def step() -> None:
        data.ctrl[:] = 0.3
        for _ in range(env.action_repeat):
            mujoco.mj_step(model, data)
        renderer.update_scene(data, env.camera_name)
        renderer.render()
        renderer.enable_segmentation_rendering()
        renderer.render()
        renderer.disable_segmentation_rendering()

    return step


def seconds(step: Callable[[], object], steps: int) -> float:
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return (time.perf_counter() - start) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--image-size", type=int, default=64)
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    env = Reacher(image_size=arguments.image_size, horizon=10**9)
    env.reset(seed=0)
    action = np.full(2, 0.3)
    wrapped = make_env("reacher", image_size=arguments.image_size, horizon=10**9, seed=0)
    tensordict = wrapped.reset().set("action", torch.full((2,), 0.3))
    env.model.vis.quality.offsamples = 0
    renderer = mujoco.Renderer(env.model, env.image_size, env.image_size)
    turns: dict[str, Callable[[], object]] = {
        "minimum": minimum(env, renderer),
        "gymnasium environment": lambda: env.step(action),
        "TorchRL environment": lambda: wrapped.step(tensordict),
    }
    times: dict[str, list[float]] = {name: [] for name in turns}
    for step in turns.values():
        seconds(step, 50)
    for _ in range(arguments.rounds):
        for name, step in turns.items():
            times[name].append(seconds(step, arguments.steps))

    print(f"Reacher, {arguments.image_size} x {arguments.image_size}, median of {arguments.rounds} turns")
    print(f"{'':24}{'steps/s':>10}{'of the minimum':>16}")
    for name, values in times.items():
        ratio = statistics.median(low / value for low, value in zip(times["minimum"], values, strict=True))
        print(f"{name:24}{1 / statistics.median(values):10.0f}{ratio:16.2f}")
    renderer.close()
    wrapped.close()
    env.close()


if __name__ == "__main__":
    main()
