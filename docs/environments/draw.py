"""Draw each environment with its workspace, goals and frame of reference: ``python docs/environments/draw.py``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from itertools import combinations, product
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv, Workspace

SIZE = 480  # pixels
AXIS = 0.3  # of the workspace's larger side
NAMES = "xyz"
GOALS = "#00a8ff"


def draw(env: PositioningEnv, axes: plt.Axes) -> None:
    observation, _ = env.reset(seed=0)
    workspace = env.workspace
    axes.imshow(observation["pixels"].transpose(1, 2, 0), extent=(0, SIZE, SIZE, 0))
    for line in cells(workspace) if workspace.dim == 2 else edges(workspace):
        axes.plot(*env.project(line).T, color=GOALS, linewidth=0.4, alpha=0.7)
    goals = env.project(workspace.grid(10).flatten(0, 1).numpy())
    axes.scatter(*goals.T, s=6, color=GOALS, label="goals of the evaluation")
    landmarks = env.project(np.array(workspace.landmarks))
    axes.scatter(*landmarks.T, s=45, marker="X", color="#ffd21f", edgecolor="black", linewidth=0.6, label="landmarks")
    length = AXIS * max(np.subtract(workspace.high, workspace.low))
    origin = env.project(np.zeros(workspace.dim))
    for axis, name in enumerate(NAMES[index] for index in env.axes):
        tip = env.project(length * np.eye(workspace.dim)[axis])
        arrow = {"arrowstyle": "->", "color": "#ff3b30", "linewidth": 1.8}
        axes.annotate("", xy=tip, xytext=origin, arrowprops=arrow)
        axes.annotate(name, xy=tip, color="#ff3b30", fontsize=12, xytext=(4, 4), textcoords="offset points")
    axes.set(xlim=(0, SIZE), ylim=(SIZE, 0), xticks=[], yticks=[])
    axes.legend(loc="lower right", fontsize=8)


def cells(workspace: Workspace) -> Iterator[np.ndarray]:
    """The lines of the grid that goals lie on."""
    corners = workspace.grid_edges(10)
    yield from (*corners.numpy(), *corners.transpose(0, 1).numpy())


def edges(workspace: Workspace) -> Iterator[np.ndarray]:
    """The edges of the box."""
    corners = np.array(list(product(*zip(workspace.low, workspace.high, strict=True))))
    yield from (np.array(pair) for pair in combinations(corners, 2) if (pair[0] != pair[1]).sum() == 1)


def main() -> None:
    for name, environment in ENVIRONMENTS.items():
        figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
        with closing(gymnasium.make(environment.id, image_size=SIZE).unwrapped) as env:
            draw(env, axes)
        figure.savefig(Path(__file__).with_name(f"{name}.png"), dpi=80)
        plt.close(figure)


if __name__ == "__main__":
    main()
