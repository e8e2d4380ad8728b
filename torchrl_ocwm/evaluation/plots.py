"""Pictures of scores: heatmaps over the workspace and learning curves."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib
import numpy as np
from torch import Tensor

from torchrl_ocwm.envs.workspace import Workspace

matplotlib.use("Agg")
from matplotlib import pyplot as plt


def heatmap(path: str | Path, scores: dict[str, Tensor], workspace: Workspace, *, title: str = "") -> None:
    """Draw the score of each goal of the evaluation grid where it lies, one panel per agent.

    Args:
        path: PNG file to write.
        scores: Name → ``[size * size]`` scores in [0, 1], in the order of :meth:`Workspace.grid`.
        workspace: The workspace that the grid covers.
        title: Written above.
    """
    figure, axes = plt.subplots(1, len(scores), figsize=(3.2 * len(scores) + 0.8, 3.6), squeeze=False)
    for axis, (name, values) in zip(axes[0], scores.items(), strict=True):
        size = round(len(values) ** 0.5)
        edges = 100 * workspace.grid_edges(size)
        x, y = edges[..., 0].numpy(), edges[..., -1].numpy()
        mesh = axis.pcolormesh(x, y, values.reshape(size, size).numpy(), vmin=0, vmax=1, cmap="viridis")
        axis.set_title(f"{name}: {values.mean():.2f}")
        axis.set_aspect("equal")
        axis.set_xlabel("cm")
    figure.colorbar(mesh, ax=axes[0].tolist(), label="score", shrink=0.8)
    if title:
        figure.suptitle(title)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)


def learning_curves(path: str | Path, runs: dict[str, list[Path]], metrics: dict[str, str]) -> None:
    """Draw metrics that training logged, the mean over the runs of each agent and their range.

    Args:
        path: PNG file to write.
        runs: Name → folders of its runs, one per seed.
        metrics: Logged name → axis label, one panel each.
    """
    size = (4.2 * len(metrics), 3.2)
    figure, axes = plt.subplots(1, len(metrics), figsize=size, squeeze=False, layout="constrained")
    for axis, (metric, label) in zip(axes[0], metrics.items(), strict=True):
        for name, folders in runs.items():
            found = [read_scalar(folder, metric) for folder in folders]
            curves = [curve for curve in found if curve is not None]
            if not curves:
                continue
            length = min(len(steps) for steps, _ in curves)
            steps = curves[0][0][:length]
            values = np.stack([values[:length] for _, values in curves])
            (line,) = axis.plot(steps, values.mean(0), label=name)
            if len(curves) > 1:
                axis.fill_between(steps, values.min(0), values.max(0), alpha=0.2, color=line.get_color())
        if metric.startswith("loss_model"):
            axis.set_yscale("log")
        axis.set_xlabel("updates")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend()
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)


def read_scalar(folder: Path, metric: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Steps and values that TorchRL's CSV logger wrote for a metric, or ``None`` if there are none.

    A resumed run may have logged a step twice; the later value counts.
    """
    files = list(folder.rglob(f"scalars/{metric}.csv"))
    if not files:
        return None
    with files[0].open() as file:
        values = {int(step): float(value) for step, value in csv.reader(file)}
    order = sorted(values)
    return np.array(order), np.array([values[step] for step in order])
