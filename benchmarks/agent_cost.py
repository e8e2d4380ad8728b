"""Seconds per update, peak memory and the share of each part, of every agent, beside a reference timed in the same run.

    python benchmarks/agent_cost.py [--agents dreamer focus_lcp ...] [--sizes cpu small paper] [--threads 2]
        [--rounds 10] [--updates 1] [--budget 60] [--device cpu] [--compile]
        [--mixed-precision]

Each agent at each size has a process of its own, one after the other, so that its peak memory is its own: the largest
resident set of the process, Python and PyTorch with it; on a GPU what PyTorch had allocated there. Records are random,
of a task with proprio 50, action 4, one object in three dimensions and images of 64 x 64 pixels, whatever the size.

A round is the reference and then some updates, so that a noisy machine slows both. The reference is plain PyTorch in
float32, the sum of two things: a product of two 1024 x 1024 matrices, and forward and backward pass of four strided
convolutions on 16 images of 64 x 64 pixels. "x reference" is the median over rounds of their quotient and compares
machines; seconds do not. A round that would start after the time budget is left out, but never one of the first three.

Shares are of updates of their own, run eagerly after the others, whose graph is cut where one part hands over to the
next: its outputs go on as leaves, and their gradients are handed back to it in the end. The same work is done, and the
clock is read at every cut. The parts, each forward and backward:

    encoder      images and vectors to embeddings
    RSSM         the rollout over the sequences, prior and posterior
    decoders     all that the world model predicts from the latents: images, vectors, objects, reward, continuation,
                 and the latents that goals are made of
    imagination  goals, imagined trajectories, losses of actor, critic and of what rewards learn, for each behaviour
    optimiser    zeroed gradients, the optimiser's step, the slow critic
    other        the rest: the selection of records and the losses of the predictions, KL included

They are medians of seconds over their sum, and so add up to one. How long such updates take, compared with the ones
that were timed whole, is printed below the table; if it is far from 1, do not trust the shares.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import RSSMRolloutV3
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents import AGENTS, SIZES, Agent, build_agent
from torchrl_ocwm.envs import Task, Workspace
from torchrl_ocwm.testing import random_records
from torchrl_ocwm.training import Training, make_stepper

T = TypeVar("T")

TASK = Task("benchmark", 64, ("object",), 50, 4, Workspace(low=(-0.3, -0.3, 0.0), high=(0.3, 0.3, 0.3)))
PARTS = ("encoder", "RSSM", "decoders", "imagination", "optimiser", "other")
LEAST_ROUNDS = 3


def clock(device: str) -> float:
    """Seconds, after what was sent to a GPU is done."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def timed(function: Callable[[], object], device: str) -> float:
    """Seconds that a call takes."""
    start = clock(device)
    function()
    return clock(device) - start


def within(budget: float, rounds: int, measure: Callable[[], T]) -> list[T]:
    """One measurement per round, until the seconds are used up; the first three in any case."""
    start = time.perf_counter()
    values: list[T] = []
    while len(values) < rounds and (len(values) < LEAST_ROUNDS or time.perf_counter() - start < budget):
        values.append(measure())
    return values


def make_reference(device: str) -> Callable[[], tuple[float, float]]:
    """What to compare with: gives the seconds of a matrix product and of forward and backward pass of convolutions."""
    generator = torch.Generator().manual_seed(0)
    left, right = (torch.rand(1024, 1024, generator=generator).to(device) for _ in range(2))
    images = torch.rand(16, 3, 64, 64, generator=generator).to(device)
    widths = (3, 32, 64, 128, 256)
    layers = [(nn.Conv2d(a, b, 4, 2), nn.ReLU()) for a, b in pairwise(widths)]
    network = nn.Sequential(*(layer for pair in layers for layer in pair)).to(device)

    def convolutions() -> None:
        network.zero_grad()
        network(images).sum().backward()

    def reference() -> tuple[float, float]:
        return timed(lambda: left @ right, device), timed(convolutions, device)

    reference()
    return reference


class Cut:
    """The end of a module's part of the graph.

    A call of the module is timed, and its outputs go on as leaves. :meth:`backward` hands their gradients back to it.

    Args:
        module: Called once per update; returns a tensor or a tensordict.
        device: Where it is.

    Attributes:
        seconds: What the last call took.
    """

    def __init__(self, module: nn.Module, device: str) -> None:
        self.device, self.seconds, self.start = device, 0.0, 0.0
        self.ends: list[tuple[Tensor, Tensor]] = []
        module.register_forward_pre_hook(self._enter)
        module.register_forward_hook(self._leave)

    def backward(self) -> None:
        """The backward pass of the module."""
        ends = [(end, leaf.grad) for end, leaf in self.ends if leaf.grad is not None]
        self.ends = []
        torch.autograd.backward([end for end, _ in ends], [grad for _, grad in ends])

    def _enter(self, *_: object) -> None:
        self.start = clock(self.device)

    def _leave(self, module: nn.Module, inputs: object, output: Any) -> Any:  # noqa: ARG002
        self.seconds = clock(self.device) - self.start
        if isinstance(output, Tensor):
            return self._leaf(output)
        for key, value in list(output.items(True, True)):
            if value.grad_fn is not None:
                output.set(key, self._leaf(value))
        return output

    def _leaf(self, end: Tensor) -> Tensor:
        leaf = end.detach().requires_grad_()
        self.ends.append((end, leaf))
        return leaf


class CutUpdate:
    """An update that does what the stepper's does, and gives the seconds of each of the :data:`PARTS`.

    Args:
        agent: What to update; its modules keep hooks, so that it is of no use afterwards.
        stepper: The agent's.
        device: Where it is.
    """

    def __init__(self, agent: Agent, stepper: DreamerV3OptimizationStepper, device: str) -> None:
        self.loss, self.stepper, self.device = agent.loss, stepper, device
        world_model = agent.loss.model_loss.world_model
        (rollout,) = (module for module in world_model.modules() if isinstance(module, RSSMRolloutV3))
        self.encoder, self.rollout, self.world_model = (
            Cut(module, device) for module in (agent.model.encoder, rollout, world_model)
        )

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        start = clock(self.device)
        with self._precision():
            model_losses, records = self.loss.model_loss(batch.select(*self.loss.in_keys, strict=False))
        seconds = {"encoder": self.encoder.seconds, "RSSM": self.rollout.seconds}
        seconds["decoders"] = self.world_model.seconds - sum(seconds.values())
        seconds["imagination"] = timed(lambda: self._imagine(records), self.device)
        _total(model_losses).backward()
        for name, cut in (("decoders", self.world_model), ("RSSM", self.rollout), ("encoder", self.encoder)):
            seconds[name] += timed(cut.backward, self.device)
        seconds["optimiser"] = timed(self._optimise, self.device)
        return {**seconds, "other": clock(self.device) - start - sum(seconds.values())}

    def _imagine(self, records: TensorDictBase) -> None:
        with self._precision():
            losses = [behaviour(records) for behaviour in self.loss.behaviours.values()]
        sum(map(_total, losses), torch.zeros(())).backward()

    def _precision(self) -> torch.autocast:
        return torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.stepper.mixed_precision)

    def _optimise(self) -> None:
        """The stepper zeroes the gradients before the backward pass, which is the same."""
        self.stepper.optimizer.step()
        self.stepper.target_updater.step()
        self.stepper.optimizer.zero_grad()


def _total(losses: TensorDictBase) -> Tensor:
    return sum((value for key, value in losses.items() if key.startswith("loss_")), torch.zeros(()))


def peak_mib(device: str) -> float:
    """The most memory that there was so far: of this process, or on its GPU."""
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def make_update(name: str, size: str, training: Training) -> tuple[Agent, DreamerV3OptimizationStepper]:
    """An agent and its stepper."""
    agent = build_agent(name, TASK, SIZES[size]).to(training.device).train()
    return agent, make_stepper(agent, training)


def settings(arguments: argparse.Namespace, **others: Any) -> Training:
    """How the updates are done."""
    return Training(device=arguments.device, mixed_precision=arguments.mixed_precision, **others)


def measure_whole(batch: TensorDictBase, arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds per update and of the reference, one each per round, and the peak memory of it all."""
    device = arguments.device
    agent, size = arguments.child
    _, stepper = make_update(agent, size, settings(arguments, compile=arguments.compile))
    reference = make_reference(device)
    if any(stepper.resolve(torch.device(device))):
        stepper.warmup(batch)

    def step() -> None:
        stepper.step(None, batch.copy())

    step()

    def turn() -> tuple[float, float, float]:
        updates = sum(timed(step, device) for _ in range(arguments.updates))
        return updates / arguments.updates, *reference()

    update, product, convolutions = zip(*within(arguments.budget, arguments.rounds, turn), strict=True)
    return {"update": update, "product": product, "convolutions": convolutions, "mib": peak_mib(device)}


def measure_parts(batch: TensorDictBase, arguments: argparse.Namespace) -> dict[str, float]:
    """Seconds of each part of an update."""
    device = arguments.device
    agent, size = arguments.child
    training = settings(arguments, compile=False, cudagraph=False)
    update = CutUpdate(*make_update(agent, size, training), device)
    update(batch)
    rounds = within(arguments.budget, arguments.rounds, lambda: update(batch))
    return {part: statistics.median(seconds[part] for seconds in rounds) for part in PARTS}


def child(arguments: argparse.Namespace) -> None:
    """Measure one agent at one size, and print it as JSON."""
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    size = SIZES[arguments.child[1]].learning
    batch = random_records(TASK, size.batch_size, size.slice_len).to(arguments.device)
    result = measure_whole(batch, arguments)  # first, so that the peak is its own
    print(json.dumps({**result, "parts": measure_parts(batch, arguments)}))


def run_child(agent: str, size: str) -> dict[str, Any]:
    """What a process of its own, with the same options, measures of an agent."""
    command = [sys.executable, __file__, *sys.argv[1:], "--child", agent, size]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"{agent}, size {size}: the measurement failed with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def row(agent: str, result: dict[str, Any]) -> str:
    """A row of the table."""
    seconds, mib = statistics.median(result["update"]), result["mib"]
    rounds = zip(result["update"], result["product"], result["convolutions"], strict=True)
    multiple = statistics.median(update / (product + convolutions) for update, product, convolutions in rounds)
    cells = [agent, f"{seconds:.3g}", f"{multiple:.1f}", f"{mib:.0f}"]
    whole = sum(result["parts"].values())
    return line([*cells, *(f"{result['parts'][part] / whole:.2f}" for part in PARTS)])


def line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def spread(values: Sequence[float], form: str) -> str:
    """The smallest and the largest of some numbers."""
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    return low if low == high else f"{low} to {high}"


def print_table(size: str, agents: Sequence[str], updates: int) -> None:
    """Measure the agents at a size, with a row as soon as there is one."""
    sizes, results = SIZES[size], []
    batch, depth = (sizes.learning.batch_size, sizes.learning.slice_len), sizes.architecture.cnn_depth
    print(f"\nSize {size}: {batch[0]} sequences of {batch[1]} frames, CNN depth {depth}\n")
    head = ["agent", "s/update", "x reference", "peak MiB", *PARTS]
    print(line(head), line(["---", *["---:"] * (len(head) - 1)]), sep="\n", flush=True)
    for agent in agents:
        results.append(run_child(agent, size))
        print(row(agent, results[-1]), flush=True)

    rounds = spread([len(result["update"]) for result in results], "d")
    product, convolutions = (
        spread([1000 * statistics.median(result[name]) for result in results], ".1f")
        for name in ("product", "convolutions")
    )
    cut = spread([sum(one["parts"].values()) / statistics.median(one["update"]) for one in results], ".2f")
    print(f"\nMedians of {rounds} rounds of {updates} updates.", end=" ")
    print(f"Reference: product {product} ms + convolutions {convolutions} ms.", end=" ")
    print(f"Sum of the parts / update: {cut}.", flush=True)


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise ValueError
    return value


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=list(AGENTS), metavar="AGENT")
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=["cpu", "small"], metavar="SIZE")
    parser.add_argument("--threads", type=positive, default=2)
    parser.add_argument("--rounds", type=positive, default=10, help="at most, for the updates and again for the parts")
    parser.add_argument("--updates", type=positive, default=1, help="updates per round")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds after which no further round starts")
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--compile",
        action=argparse.BooleanOptionalAction,
        help="compile the step, which takes minutes; not by default, as in training",
    )
    parser.add_argument("--mixed-precision", action="store_true", help="products and convolutions in bfloat16")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    if arguments.child:
        child(arguments)
        return
    precision = "bfloat16" if arguments.mixed_precision else "float32"
    print(f"torch {torch.__version__}, {arguments.device}, {precision}, {arguments.threads} threads", end="")
    print(f" on {os.cpu_count()} cores; medians of at most {arguments.rounds} rounds of {arguments.updates} updates")
    for size in arguments.sizes:
        print_table(size, arguments.agents, arguments.updates)


if __name__ == "__main__":
    main()
