"""Resident memory and OpenGL contexts of an environment over many steps and resets; Linux only.

    python benchmarks/env_memory.py [--env reacher] [--steps 50000] [--resets 500] [--image-size 64]

Then the environment is made, used and closed ten times. Contexts are counted among all Python objects that are alive.
"""

from __future__ import annotations

import argparse
import gc
from contextlib import closing

import gymnasium
import numpy as np

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv
from torchrl_ocwm.envs.opengl import context_class

PARTS = 5
TIMES = 10


def resident() -> float:
    """MiB of this process that are in memory."""
    gc.collect()  # robosuite's environments are reference cycles
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


def contexts() -> int:
    """OpenGL contexts that have not been collected."""
    gc.collect()
    return sum(type(thing) is context_class() for thing in gc.get_objects())


def make_one(name: str, image_size: int) -> PositioningEnv:
    return gymnasium.make(ENVIRONMENTS[name].id, image_size=image_size, horizon=10**9).unwrapped


def use(env: PositioningEnv, resets: int, steps: int, rng: np.random.Generator) -> None:
    for seed in rng.integers(2**31, size=resets):
        env.reset(seed=int(seed))
        for _ in range(steps):
            env.step(rng.uniform(-1, 1, env.action_space.shape))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="reacher")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--resets", type=int, default=500)
    parser.add_argument("--image-size", type=int, default=64)
    arguments = parser.parse_args()

    name, size, rng = arguments.env, arguments.image_size, np.random.default_rng(0)
    per_reset, resets = arguments.steps // arguments.resets, arguments.resets // PARTS
    print(f"{name}, {arguments.steps} steps, {arguments.resets} resets\n")
    print("| after | RSS, MiB | OpenGL contexts |\n|---|---:|---:|")
    with closing(make_one(name, size)) as env:
        for part in range(PARTS):
            use(env, resets, per_reset, rng)
            print(f"| {(part + 1) * resets * per_reset} steps | {resident():.1f} | {contexts()} |", flush=True)
    for _ in range(TIMES):
        with closing(make_one(name, size)) as env:
            use(env, 1, 1, rng)
    del env
    print(f"| making and closing it {TIMES} times | {resident():.1f} | {contexts()} |")


if __name__ == "__main__":
    main()
