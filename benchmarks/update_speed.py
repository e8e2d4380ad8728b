"""How much of what the processor can do goes into updates: GFLOP, operations and seconds of one, and its efficiency.

    python benchmarks/update_speed.py [--agents dreamer_pcp focus_lcp ...] [--sizes cpu small] [--rounds 9]
        [--updates 2] [--threads 1] [--device cpu] [--mixed-precision] [--compile] [--cudagraph]
        [--before COMMIT]

A round times a plain product of two 1024 x 1024 matrices in float32 and some updates on random records, so that a noisy
machine slows both. Efficiency is the GFLOP of an update by the seconds it takes and the GFLOP/s of the product in the
same round; 1 would be an update that does nothing but products of this kind. All numbers are medians over rounds.

GFLOP are those of products and convolutions, forward and backward, as PyTorch's ``flop_counter`` counts them, by a
dispatch mode of our own: ``FlopCounterMode`` cannot walk the parameters of a loss module. Operations are all calls that
reach PyTorch's dispatcher in an eager update.

``--before`` measures another commit too, in a worktree of git and in turns with this one, and says how much faster
this one is, in times. The earliest is a60843d, whose names it uses.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from torchrl_ocwm.agents import AGENTS, SIZES, build_agent
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training import Training, make_stepper

ROOT = Path(__file__).parents[1]
HEAD = ["agent", "GFLOP", "operations", "s/update", "product, GFLOP/s", "efficiency"]
SIDE = 1024
#: Options that a child needs, as it measures one agent at one size.
SHARED = ("rounds", "updates", "threads", "device", "mixed_precision", "compile", "cudagraph")


class Work(TorchDispatchMode):
    """What is computed inside: ``flop`` of products and convolutions, and the number of all ``operations``."""

    def __init__(self) -> None:
        super().__init__()
        self.flop = self.operations = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        self.operations += 1
        count = flop_registry.get(function._overloadpacket)
        if count is not None:
            self.flop += count(*args, **(kwargs or {}), out_val=result)
        return result


class Update:
    """An agent's update on random records, and the product it is compared with."""

    def __init__(self, agent: str, size: str, options: dict[str, Any]) -> None:
        torch.set_num_threads(options["threads"])
        torch.manual_seed(0)
        self.device, self.updates = options["device"], options["updates"]
        built = build_agent(agent, reacher_task(), size).to(self.device).train()
        training = Training(**{name: options[name] for name in ("device", "mixed_precision", "compile", "cudagraph")})
        self.eager = make_stepper(built, replace(training, compile=False, cudagraph=False))
        self.stepper = make_stepper(built, training)
        learning = SIZES[size].learning
        self.batch = random_records(reacher_task(), learning.batch_size, learning.slice_len).to(self.device)
        self.matrix = torch.rand(SIDE, SIDE, device=self.device)

    def count(self) -> Work:
        """The work of an eager update."""
        self.eager.step(None, self.batch.copy())
        with Work() as work:
            self.eager.step(None, self.batch.copy())
        return work

    def warmup(self) -> None:
        """Compile, where it is asked for."""
        if any(self.stepper.resolve(torch.device(self.device))):
            self.stepper.warmup(self.batch.copy())
        self.round()

    def round(self) -> tuple[float, float]:
        """Seconds of an update, and of the product."""
        update = self._seconds(lambda: self.stepper.step(None, self.batch.copy()), self.updates)
        return update, self._seconds(lambda: self.matrix @ self.matrix, 3)

    def _seconds(self, function: Any, times: int) -> float:
        start = self._clock()
        for _ in range(times):
            function()
        return (self._clock() - start) / times

    def _clock(self) -> float:
        if torch.device(self.device).type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def serve(agent: str, size: str, options: dict[str, Any]) -> None:
    """Measure a round for each line of the standard input; the first line printed is the work of an update."""
    update = Update(agent, size, options)
    work = update.count()
    update.warmup()
    print(json.dumps([work.flop, work.operations]), flush=True)
    for _ in sys.stdin:
        print(json.dumps(update.round()), flush=True)


class Child:
    """An :class:`Update` in a process of its own, with the library of a folder."""

    def __init__(self, folder: Path, agent: str, size: str, options: dict[str, Any]) -> None:
        command = [sys.executable, __file__, "--child", agent, size, json.dumps(options)]
        path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "PYTHONPATH": path}
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)
        self.flop, self.operations = self._read()

    def round(self) -> tuple[float, float]:
        """Seconds of an update and of the product, in this turn."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        update, product = self._read()
        return update, product

    def close(self) -> None:
        """End the process."""
        self.process.communicate()

    def _read(self) -> list[Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"the measurement failed with exit code {self.process.wait()}")
        return json.loads(line)


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """A folder with the files of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder, "tree")
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def row(agent: str, children: Sequence[Child], rounds: int) -> list[str]:
    """A row of the table: of the first child, and how many times faster it is than the other, if there is one."""
    first, *others = children
    times = [[child.round() for child in children] for _ in range(rounds)]
    update = statistics.median(turn[0][0] for turn in times)
    rate = statistics.median(2 * SIDE**3 / turn[0][1] for turn in times)
    efficiency = statistics.median(first.flop * turn[0][1] / (turn[0][0] * 2 * SIDE**3) for turn in times)
    cells = [agent, f"{first.flop / 1e9:.3g}", f"{first.operations:,}", f"{update:.3g}", f"{rate / 1e9:.1f}"]
    cells.append(f"{efficiency:.2f}")
    for other, child in enumerate(others, 1):
        cells += [f"{child.operations:,}", f"{statistics.median(turn[other][0] / turn[0][0] for turn in times):.2f}"]
    return cells


def line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def print_table(size: str, folders: Sequence[Path], arguments: argparse.Namespace) -> None:
    """A row for each agent, as soon as it is measured."""
    head = HEAD + (["operations before", "times faster"] if len(folders) > 1 else [])
    print(f"\nSize {size}\n\n{line(head)}\n{line(['---', *['---:'] * (len(head) - 1)])}", flush=True)
    options = {name: getattr(arguments, name) for name in SHARED}
    for agent in arguments.agents:
        with ExitStack() as stack:
            children = [Child(folder, agent, size, options) for folder in folders]
            for child in children:
                stack.callback(child.close)
            print(line(row(agent, children, arguments.rounds)), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=list(AGENTS), metavar="AGENT")
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=["cpu", "small"], metavar="SIZE")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--updates", type=int, default=2, help="updates per round")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--mixed-precision", action="store_true", help="products and convolutions in bfloat16")
    for name in ("compile", "cudagraph"):
        parser.add_argument(f"--{name}", action=argparse.BooleanOptionalAction, help="by default as in training")
    parser.add_argument("--before", metavar="COMMIT", help="a commit to compare with")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        agent, size, options = arguments.child
        serve(agent, size, json.loads(options))
        return
    precision = "bfloat16" if arguments.mixed_precision else "float32"
    print(f"torch {torch.__version__}, {arguments.device}, {precision}, {arguments.threads} threads", end="")
    print(f"; medians of {arguments.rounds} rounds of {arguments.updates} updates")
    with ExitStack() as stack:
        folders = [ROOT]
        if arguments.before:
            folders.append(stack.enter_context(checkout(arguments.before)))
        for size in arguments.sizes:
            print_table(size, folders, arguments)


if __name__ == "__main__":
    main()
