"""Pictures of scores: heatmaps over the workspace and learning curves."""

from __future__ import annotations

import warnings
from itertools import combinations, product
from pathlib import Path
from textwrap import fill

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from torch import Tensor

from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.evaluation.output import writing

matplotlib.use("Agg")
from matplotlib import pyplot as plt


def heatmap(path: str | Path, scores: dict[str, Tensor], workspace: Workspace, *, title: str = "") -> None:
    """Draw the score of each goal of the evaluation grid where it lies.

    One panel per agent; with three axes three of them, seen along each axis.

    Args:
        path: PNG file to write.
        scores: Name → ``[size * size]`` scores in [0, 1], in the order of :meth:`Workspace.grid`. NaN is left blank.
        workspace: The workspace that the grid covers.
        title: Written above.
    """
    views: list[tuple[int, int] | None] = [*combinations(range(workspace.dim), 2)] or [None]
    columns = len(views) if len(views) > 1 else 5
    figure, axes = _panels(len(scores) * len(views), columns=columns, width=3.2, height=3.4)
    for axis, ((name, values), view) in zip(axes, product(scores.items(), views), strict=True):
        drawn = _draw_strip(axis, values, workspace) if view is None else _draw_scores(axis, values, workspace, view)
        axis.set_title(fill(f"{name}: {values.nanmean():.2f}", 28))
    figure.colorbar(drawn, ax=axes, label="score", shrink=0.8)
    if title:
        figure.suptitle(title)
    save_figure(figure, path)


def _draw_scores(axis: Axes, scores: Tensor, workspace: Workspace, view: tuple[int, int]) -> QuadMesh:
    """The mean score of the goals in each cell, seen along all axes but these two."""
    if workspace.dim > 2:
        axis.set_ylabel(f"{_axis_name(workspace, view[1])}, cm")
    axis.set_xlabel(f"{_axis_name(workspace, view[0])}, cm" if workspace.dim > 2 else "cm")
    axis.set_aspect("equal")
    size = round(len(scores) ** 0.5)
    column, row = workspace.grid_cells(size).flatten(0, 1)[:, view].unbind(-1)
    total, count = (
        torch.zeros(size, size).index_put((row, column), values.float(), accumulate=True)
        for values in (scores, torch.ones_like(scores))
    )
    x, y = (100 * workspace.grid_edges(size, view)).unbind(-1)
    return axis.pcolormesh(x.numpy(), y.numpy(), (total / count).numpy(), vmin=0, vmax=1, cmap="viridis")


def _draw_strip(axis: Axes, scores: Tensor, workspace: Workspace) -> QuadMesh:
    """The score of each goal on a line."""
    axis.set_xlabel("cm")
    axis.set_yticks([])
    ends = np.linspace(100 * workspace.low[0], 100 * workspace.high[0], len(scores) + 1)
    return axis.pcolormesh(ends, [0, 1], scores.unsqueeze(0).numpy(), vmin=0, vmax=1, cmap="viridis")


def _axis_name(workspace: Workspace, axis: int) -> str:
    return "xyz"[axis] if workspace.dim == 3 else f"axis {axis + 1}"


def learning_curves(path: str | Path, runs: dict[str, list[Path]], metrics: dict[str, str]) -> bool:
    """Draw metrics that training logged, the mean over the runs of each agent and their range.

    Args:
        path: PNG file to write.
        runs: Name → folders of its runs, one per seed.
        metrics: Logged name → axis label, one panel each. What no run has logged gets no panel.

    Returns:
        Whether there was anything to draw. Without it there is no picture.
    """
    found = {metric: {name: _curves(folders, metric) for name, folders in runs.items()} for metric in metrics}
    found = {metric: curves for metric, curves in found.items() if any(curves.values())}
    if not found:
        return False
    figure, axes = _panels(len(found), columns=4, width=4.2, height=3.2)
    for axis, (metric, agents) in zip(axes, found.items(), strict=True):
        for color, (name, curves) in enumerate(agents.items()):
            if curves:
                _draw_seeds(axis, curves, name, f"C{color}")
        if metric.startswith("loss_model"):
            axis.set_yscale("log")
        axis.set_xlabel("updates")
        axis.set_ylabel(metrics[metric])
        axis.grid(alpha=0.3)
    _explain(figure, axes)
    save_figure(figure, path)
    return True


def metric_lines(
    path: str | Path, lines: dict[str, dict[str, dict[str, tuple[float, float | None] | None]]], places: str
) -> None:
    """Draw how metrics change from one place of a line to the next, one panel per metric.

    Args:
        path: PNG file to write.
        lines: Metric → line → place → mean and error, ``None`` where there is nothing.
        places: What the places are.
    """
    figure, axes = _panels(len(lines), columns=4, width=4.2, height=3.2)
    for axis, (metric, found) in zip(axes, lines.items(), strict=True):
        for name, points in found.items():
            there = {place: pair for place, pair in points.items() if pair is not None}
            means = [mean for mean, _ in there.values()]
            axis.errorbar(list(there), means, [error or 0 for _, error in there.values()], label=name, marker="o")
        axis.set_xlabel(places)
        axis.set_ylabel(metric)
        axis.grid(alpha=0.3)
    _explain(figure, axes)
    save_figure(figure, path)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a picture, and forget it.

    Raises:
        OutputError: if it cannot be written.
    """
    try:
        with writing(path) as file:
            figure.savefig(file, dpi=120, bbox_inches="tight")
    finally:
        plt.close(figure)


def _panels(number: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with this many panels, in rows of at most ``columns``."""
    columns = min(number, columns)
    rows = -(-number // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(width * columns, height * rows), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[number:]:
        axis.remove()
    return figure, list(axes.flat[:number])


def _explain(figure: Figure, axes: list[Axes]) -> None:
    """One legend for all panels, above them, where it hides nothing."""
    found = {name: line for axis in axes for line, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    columns = min(len(found), 2 * len(axes))
    figure.legend(found.values(), found.keys(), loc="outside upper center", ncols=columns, fontsize="small")


def _draw_seeds(axis: Axes, curves: list[tuple[np.ndarray, np.ndarray]], name: str, color: str) -> None:
    length = min(len(steps) for steps, _ in curves)
    steps = curves[0][0][:length]
    values = np.stack([values[:length] for _, values in curves])
    axis.plot(steps, values.mean(0), label=name, color=color)
    if len(curves) > 1:
        axis.fill_between(steps, values.min(0), values.max(0), alpha=0.2, color=color)


def _curves(folders: list[Path], metric: str) -> list[tuple[np.ndarray, np.ndarray]]:
    found = (read_scalar(folder, metric) for folder in folders)
    return [curve for curve in found if curve is not None]


def read_scalar(folder: Path, metric: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Steps and values that TorchRL's CSV logger wrote for a metric, or ``None`` if there are none.

    A resumed run may have logged a step twice; the later value counts. A line that was cut, as by a full disk or a
    power cut, is left out with a warning.
    """
    files = list(folder.rglob(f"scalars/{metric}.csv"))
    if not files:
        return None
    values, cut = {}, 0
    with files[0].open(newline="", encoding="utf-8") as file:
        for line in file:
            try:
                step, value = line.split(",")
                values[int(step)] = float(value)
            except ValueError:
                cut += 1
    if cut:
        warnings.warn(f"{files[0]}: {cut} line(s) are not a step and a value; left out", RuntimeWarning, stacklevel=2)
    if not values:
        return None
    order = sorted(values)
    return np.array(order), np.array([values[step] for step in order])
