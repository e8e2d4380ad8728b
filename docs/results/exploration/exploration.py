r"""How much of the workspace an object visits, and how often it moves, against the steps of several datasets.

    python docs/results/exploration/exploration.py random=data/random plan2explore=data/plan2explore \
        [--object cube] [--points 20] [--steps 50000] [--output docs/results/exploration]

Prints a table of all datasets after the same steps, those of the shortest or ``--steps``; writes it and the curves as
``results.md``, ``results.json`` and ``exploration.png``. The datasets are of one task.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from matplotlib import pyplot as plt

from torchrl_ocwm.data import Coverage, EpisodeDataset, coverage_curve, object_positions
from torchrl_ocwm.envs import Task
from torchrl_ocwm.evaluation import save_figure

Curves = dict[str, dict[int, Coverage]]
LABELS = {"visited": "share of the workspace visited", "moves": "share of the steps with motion"}


def measure(datasets: dict[str, Path], name: str | None, points: int, steps: int | None) -> Curves:
    """The curve of each dataset, all of the same steps up to an episode."""
    opened = {label: EpisodeDataset.open(path) for label, path in datasets.items()}
    task = one_task(opened)
    index = 0 if name is None else task.objects.index(name)
    limit = min(steps or dataset.num_steps for dataset in opened.values())
    limit = min(limit, *(dataset.num_steps for dataset in opened.values()))
    curves = {}
    for label, dataset in opened.items():
        lengths = first_episodes(dataset.episode_lengths, limit)
        positions = object_positions(dataset)[: sum(lengths), index].clone()
        curves[label] = coverage_curve(positions, lengths, task.workspace, points=points)
    return curves


def one_task(datasets: dict[str, EpisodeDataset]) -> Task:
    """The task of all datasets."""
    tasks = {label: dataset.task for label, dataset in datasets.items()}
    first, *others = tasks
    for label in others:
        if tasks[label] != tasks[first]:
            raise SystemExit(f"{label} is of {tasks[label]}, {first} of {tasks[first]}; compare them apart")
    return tasks[first]


def first_episodes(lengths: list[int], steps: int) -> list[int]:
    """The lengths of the first episodes that have so many steps, at least one."""
    chosen: list[int] = []
    for length in lengths:
        if chosen and sum(chosen) - len(chosen) + length - 1 > steps:
            break
        chosen.append(length)
    return chosen


def table(curves: Curves) -> str:
    """The last point of each curve."""
    lines = ["| data | steps | workspace visited | steps with motion |", "|---|---|---|---|"]
    for label, curve in curves.items():
        steps, last = max(curve), curve[max(curve)]
        lines.append(f"| {label} | {steps:,} | {last.visited:.0%} | {last.moves:.0%} |")
    return "\n".join(lines)


def draw(path: Path, curves: Curves) -> None:
    """Both shares against steps."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained")
    for axis, (field, label) in zip(axes, LABELS.items(), strict=True):
        for name, curve in curves.items():
            axis.plot(list(curve), [getattr(one, field) for one in curve.values()], label=name)
        axis.set_xlabel("environment steps")
        axis.set_ylabel(label)
        axis.set_ylim(0, 1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--object", help="of the task; the first, if none is given")
    parser.add_argument("--points", type=int, default=20, help="of each curve")
    parser.add_argument("--steps", type=int, help="of each dataset that count")
    parser.add_argument("--output", type=Path, default=Path("outputs/exploration"))
    arguments = parser.parse_args()
    datasets = {name: Path(folder) for name, _, folder in (one.partition("=") for one in arguments.datasets)}
    curves = measure(datasets, arguments.object, arguments.points, arguments.steps)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "results.md").write_text(table(curves) + "\n")
    numbers = {name: {steps: seen._asdict() for steps, seen in curve.items()} for name, curve in curves.items()}
    (arguments.output / "results.json").write_text(json.dumps(numbers, indent=1) + "\n")
    draw(arguments.output / "exploration.png", curves)
    print(table(curves))


if __name__ == "__main__":
    main()
