"""Where the time of an evaluation goes, and how long it takes beside another commit.

    MUJOCO_GL=egl python benchmarks/evaluation_speed.py CHECKPOINT [--goals 100] [--steps 150] [--rounds 3]
        [--workers 2] [--image-goals] [--before COMMIT [--before-checkpoint FILE]]

Runs ``ocwm evaluate`` with the library's functions timed: seconds that pass in each part, those of the parts
within it not counted. ``--workers 0`` steps the environments in the process that evaluates, which shows what their
steps consist of. All numbers are medians over rounds; "processor" is the time of all processes together, which says
more than the others on a machine that does something else too.

``--before`` runs another commit too, in a worktree of git and in turns with this one, and says whether its scores are
the same, goal by goal. What that commit does elsewhere counts to "everything else" there. ``--before-checkpoint`` is
for a commit that cannot read the checkpoints of this one. Parts are those of the main thread.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import runpy
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any

from update_speed import ROOT, checkout, line

#: Part → functions, ``module:name``, that do it. What none of them does is "everything else".
PARTS = {
    "start of processes": ["processes:ProcessWorker.ready"],
    "goal images": ["recipes.evaluate:goal_images"],
    "episodes, beside the next three": ["evaluation.episodes:EvaluationEnvs.run"],
    "policy": ["agents.agent:Policy.forward", "data.policies:SmoothRandomPolicy.forward"],
    "reconstruction errors": ["evaluation.reconstruction:ReconstructionError.__call__"],
    "steps, or waiting for those of processes": [
        "processes:ProcessWorker.request",
        "processes:ProcessWorker.answer",
        "processes:LocalWorker.answer",
    ],
    "  rendering": ["envs.camera:Camera.render"],
    "  positions from masks": ["envs.positioning:masks_to_positions"],
    "  physics, rest of the environment": ["envs.positioning:PositioningEnv.step"],
    "imagined distances": ["recipes.scores:imagined_distance"],
    "heatmap, learning curves": ["recipes.evaluate:draw"],
    "films": ["recipes.evaluate:film"],
    "pictures of objects": ["recipes.evaluate:picture_episodes"],
    "writing of videos": ["evaluation.videos:write_video", "evaluation.object_pictures:write_video"],
}
WHOLE = ("start of processes",)  # parts within count to it
ELSE, ALL, PROCESSOR = "everything else, such as imports", "**all**", "**processor**"


class Clock:
    """Seconds that pass in parts, without those of the parts within them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._within = 0.0
        self._whole = False

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what passes inside."""
        if self._whole or threading.current_thread() is not threading.main_thread():
            yield
            return
        self._whole = name in WHOLE
        start, outside, self._within = time.perf_counter(), self._within, 0.0
        try:
            yield
        finally:
            self._whole = False
            spent = time.perf_counter() - start
            self.seconds[name] += spent - self._within
            self._within = outside + spent

    def watch(self, owner: Any, function: str, name: str) -> None:
        """Count a function to a part from now on."""
        inner: Callable[..., Any] = getattr(owner, function)

        @wraps(inner)
        def timed(*arguments: Any, **named: Any) -> Any:
            with self.part(name):
                return inner(*arguments, **named)

        setattr(owner, function, timed)


def evaluate(folder: str, *arguments: str) -> None:
    """Evaluate as the script of a checkout does, and print the seconds of each part as JSON."""
    clock = Clock()
    with clock.part(ELSE):
        for name, functions in PARTS.items():
            for place in functions:
                # An older commit may lack one: its time is "everything else" there.
                with suppress(*(() if Path(folder) == ROOT else (ImportError, AttributeError))):
                    owner, function = find(place)
                    clock.watch(owner, function, name)
        script = Path(folder, "examples", "evaluate.py")
        sys.argv = [str(script), *arguments]
        runpy.run_path(str(script), run_name="__main__")
    print("\n" + json.dumps(clock.seconds))


def find(place: str) -> tuple[Any, str]:
    """Where a function of :data:`PARTS` is, and its name there."""
    room, _, path = place.partition(":")
    owner: Any = importlib.import_module(f"torchrl_ocwm.{room}")
    *classes, function = path.split(".")
    for one in classes:
        owner = getattr(owner, one)
    getattr(owner, function)
    return owner, function


def measure(folder: Path, checkpoint: Path, arguments: argparse.Namespace) -> tuple[dict[str, float], Any]:
    """Seconds of each part of an evaluation, and what it found for each goal."""
    with tempfile.TemporaryDirectory() as output:
        given = {
            "checkpoint": checkpoint,
            "goals": arguments.goals,
            "episode_steps": arguments.steps,
            "workers": arguments.workers,
            "image_goals": arguments.image_goals,
            "output": output,
        }
        settings = [f"{key}={value}" for key, value in given.items()]
        command = [sys.executable, __file__, "--child", str(folder), *settings]
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        spent, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            raise SystemExit(f"the evaluation failed with exit code {done.returncode}:\n{done.stderr}")
        seconds = json.loads(done.stdout.splitlines()[-1])
        seconds[ELSE] += spent - sum(seconds.values())
        processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        found = json.loads(Path(output, "results.json").read_text())["agents"]
        scores = {name: row["per_goal"] for name, row in found.items()}
        return {**seconds, ALL: spent, PROCESSOR: processor}, scores


def table(turns: Sequence[Sequence[dict[str, float]]], workers: int) -> Iterator[str]:
    """Lines: seconds of each part now, share of all, and before, with how many times faster it is now."""
    several = len(turns[0]) > 1
    head = ["part", "seconds", "share", *(["seconds before", "times faster"] if several else [])]
    yield line(head)
    yield line(["---", *["---:"] * (len(head) - 1)])
    for name in (*PARTS, ELSE, ALL, PROCESSOR):
        if workers and name.startswith("  "):  # in another process
            continue
        times = [[one.get(name, 0.0) for one in turn] for turn in turns]
        now = statistics.median(time[0] for time in times)
        share = statistics.median(turn[0].get(name, 0.0) / turn[0][ALL] for turn in turns)
        cells = [name.replace("  ", "– "), f"{now:.1f}", f"{share:.2f}" if name != PROCESSOR else ""]
        if several:
            before = statistics.median(time[1] for time in times)
            cells += [f"{before:.1f}", f"{statistics.median(b / n for n, b in times):.2f}" if now >= 0.05 else ""]
        yield line(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="of an agent")
    parser.add_argument("--goals", type=int, default=100)
    parser.add_argument("--steps", type=int, default=150, help="of an episode")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2, help="processes that step environments")
    parser.add_argument("--image-goals", action="store_true", help="give the goals as images too")
    parser.add_argument("--before", metavar="COMMIT", help="a commit to compare with")
    parser.add_argument("--before-checkpoint", type=Path, metavar="FILE", help="of an agent, for that commit")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        turn = [(ROOT, arguments.checkpoint)]
        if arguments.before:
            old = arguments.before_checkpoint or arguments.checkpoint
            turn.append((stack.enter_context(checkout(arguments.before)), old))
        rounds = [
            [measure(folder, file.resolve(), arguments) for folder, file in turn] for _ in range(arguments.rounds)
        ]
    about = f"{arguments.goals} goals, {arguments.steps} steps, {arguments.workers} processes"
    print(f"{about}; medians of {len(rounds)} rounds")
    print("\n".join(table([[seconds for seconds, _ in turn] for turn in rounds], arguments.workers)))
    if arguments.before:
        same = all(scores == rounds[0][0][1] for turn in rounds for _, scores in turn)
        print(f"\nscores are {'the same' if same else 'NOT the same'}, goal by goal")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        evaluate(*sys.argv[2:])
    else:
        main()
