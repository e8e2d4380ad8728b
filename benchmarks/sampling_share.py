"""Updates per second, and how much of an update is spent on sampling from the dataset (the goal: below 10 %).

    python benchmarks/sampling_share.py [--agent dreamer_pcp] [--size cpu] [--threads 1] [--rounds 20] [--updates 10]
        [--dataset DATASET] [--device cpu] [--compile]

An update is a sample from the dataset, with fresh goals, and a step of the stepper on it, as in training: one process,
one after the other, so that a noisy machine slows both. Without a dataset a temporary one of 20,000 random steps is
made (0.3 GB); it comes from the system's cache, as one does that fits in memory.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable

import torch
from tensordict import TensorDictBase

from torchrl_ocwm.agents import AGENTS, SIZES, Agent, build_agent
from torchrl_ocwm.data import EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.envs import Task
from torchrl_ocwm.testing import random_dataset, reacher_task
from torchrl_ocwm.training import Training, make_stepper

EPISODES, LENGTH = 40, 501


def make_sampler(agent: Agent, dataset: EpisodeDataset, device: str) -> Callable[[], TensorDictBase]:
    """Batches as in training."""
    replay = make_replay_buffer(
        dataset,
        batch_size=agent.size.learning.batch_size,
        slice_len=agent.size.learning.slice_len,
        transform=RelabelGoals(agent.task.workspace),
    )
    return lambda: replay.sample().to(device)


def clock(device: str) -> float:
    """Seconds, after what was sent to a GPU is done."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def turn(
    sample: Callable[[], TensorDictBase], step: Callable[[TensorDictBase], object], device: str, updates: int
) -> tuple[float, float]:
    """Seconds per sample and per step."""
    sampling = stepping = 0.0
    for _ in range(updates):
        start = clock(device)
        batch = sample()
        middle = clock(device)
        step(batch)
        sampling, stepping = sampling + middle - start, stepping + clock(device) - middle
    return sampling / updates, stepping / updates


def measure(dataset: EpisodeDataset, arguments: argparse.Namespace) -> tuple[list[float], list[float]]:
    """Seconds per sample and per step, for each round."""
    device = arguments.device
    agent = build_agent(arguments.agent, Task.from_dict(dataset.metadata["task"]), arguments.size).to(device).train()
    stepper = make_stepper(agent, Training(device=device, compile=arguments.compile))
    sample = make_sampler(agent, dataset, device)
    if any(stepper.resolve(torch.device(device))):
        stepper.warmup(sample())

    def step(batch: TensorDictBase) -> object:
        return stepper.step(None, batch)

    turn(sample, step, device, arguments.updates)
    rounds = [turn(sample, step, device, arguments.updates) for _ in range(arguments.rounds)]
    sampling, stepping = zip(*rounds, strict=True)
    return list(sampling), list(stepping)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", choices=AGENTS, default="dreamer_pcp")
    parser.add_argument("--size", choices=SIZES, default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--updates", type=int, default=10, help="updates per round")
    parser.add_argument("--dataset")
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--compile",
        action=argparse.BooleanOptionalAction,
        help="compile the step, which takes minutes; not by default, as in training",
    )
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)

    with tempfile.TemporaryDirectory() as folder:
        dataset = (
            EpisodeDataset.open(arguments.dataset)
            if arguments.dataset
            else random_dataset(f"{folder}/data", reacher_task(), episodes=EPISODES, length=LENGTH)
        )
        sampling, stepping = measure(dataset, arguments)

    whole = [sum(parts) for parts in zip(sampling, stepping, strict=True)]
    share = statistics.median(part / update for part, update in zip(sampling, whole, strict=True))
    size = SIZES[arguments.size].learning
    print(f"{arguments.agent}, size {arguments.size}, {size.batch_size} sequences of {size.slice_len} frames", end="")
    print(f", {dataset.num_steps} steps; {arguments.device}, {arguments.threads} threads", end="")
    print(f", median of {arguments.rounds} rounds of {arguments.updates} updates")
    for name, values in {"sample": sampling, "step": stepping, "update": whole}.items():
        print(f"{name:24}{1000 * statistics.median(values):10.2f} ms")
    print(f"{'updates/s':24}{1 / statistics.median(whole):10.2f}")
    print(f"{'sampling / update':24}{share:10.1%}")


if __name__ == "__main__":
    main()
