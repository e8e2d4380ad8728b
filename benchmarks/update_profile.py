"""Which kinds of operations an update spends its time in, on a CPU.

    python benchmarks/update_profile.py [--agents dreamer_pcp focus_lcp ...] [--size cpu] [--updates 5]

One thread, float32, random records. Shares of the time inside PyTorch's operations and autograd functions, by their
name and the number of elements of their largest input; ``cat`` counts as large, as its inputs are not noted. What is
left to Python is not in it, and profiling slows small operations down.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from math import prod

import torch
from torch.profiler import ProfilerActivity, profile

from torchrl_ocwm.agents import AGENTS, SIZES, build_agent
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training import Training, make_stepper

LARGE = 2**18  # elements; nearly all such tensors are images
KINDS = ("convolutions", "products", "other, large tensors", "other, small tensors")
PRODUCTS = ("mm", "addmm", "bmm", "baddbmm", "mv", "addmv_")


def kind(name: str, shapes: list[list[int]]) -> str:
    """One of ``KINDS``."""
    name = name.removeprefix("aten::")
    if "convolution" in name:
        return "convolutions"
    if name in PRODUCTS:
        return "products"
    large = name == "cat" or any(shape and prod(shape) >= LARGE for shape in shapes if isinstance(shape, list))
    return "other, large tensors" if large else "other, small tensors"


def shares(agent: str, size: str, updates: int) -> list[float]:
    """The share of each kind in the time of some updates."""
    torch.manual_seed(0)
    stepper = make_stepper(build_agent(agent, reacher_task(), size).train(), Training(compile=False, cudagraph=False))
    learning = SIZES[size].learning
    batch = random_records(reacher_task(), learning.batch_size, learning.slice_len)
    for _ in range(5):
        stepper.step(None, batch.copy())
    with profile(activities=[ProfilerActivity.CPU], record_shapes=True) as profiled:
        for _ in range(updates):
            stepper.step(None, batch.copy())
    seconds = defaultdict[str, float](float)
    for row in profiled.key_averages(group_by_input_shape=True):
        seconds[kind(row.key, row.input_shapes)] += row.self_cpu_time_total
    return [seconds[one] / sum(seconds.values()) for one in KINDS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=list(AGENTS), metavar="AGENT")
    parser.add_argument("--size", choices=SIZES, default="cpu")
    parser.add_argument("--updates", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| agent, size {arguments.size} | {' | '.join(KINDS)} |\n| --- |{' ---: |' * len(KINDS)}")
    for agent in arguments.agents:
        cells = [f"{share:.2f}" for share in shares(agent, arguments.size, arguments.updates)]
        print(f"| {agent} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
