"""Whether a world model is object-centric, in pictures: what it sees and imagines of each object, and error curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib import pyplot as plt
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm.evaluation.goal_latents import cosines, distances
from torchrl_ocwm.evaluation.plots import save_figure
from torchrl_ocwm.evaluation.videos import WriteVideo, grey, tile, to_uint8, write_video
from torchrl_ocwm.modules.dtypes import unit_image
from torchrl_ocwm.objectives.focus import instance_masks

_STYLES = {"filtered": "C0", "imagined": "C3", "unmoved": "0.5"}


def object_rows(
    records: TensorDictBase, views: Mapping[str, TensorDictBase], names: Sequence[str]
) -> dict[str, Tensor]:
    """The scene, and mask and masked colours of each object: true, predicted from all frames, and imagined.

    Args:
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        views: What :func:`~torchrl_ocwm.evaluation.objects.predict_objects` gives for them.
        names: Names of the O objects.

    Returns:
        What it is → ``[N, T, 3, H, W]`` uint8, on the CPU.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.evaluation import predict_objects
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> records = random_records(reacher_task(), 2, 6)
        >>> list(object_rows(records, predict_objects(model, records, 3), ["finger"]))[3:6]
        ['finger mask: true', 'finger mask: filtered', 'finger mask: imagined']
    """
    parts = {
        "true": (
            unit_image(records["next", "pixels"]).unsqueeze(-4),
            instance_masks(records["next", "masks"]).float(),
        ),
        **{view: (latents["colours"], latents["masks"]) for view, latents in views.items()},
    }
    masked = {view: masks.unsqueeze(-3) * colours for view, (colours, masks) in parts.items()}
    rows = {f"scene: {view}": to_uint8(each.sum(-4)) for view, each in masked.items()}
    for index, name in enumerate(names):
        rows |= {f"{name} mask: {view}": grey(masks[:, :, index]) for view, (_, masks) in parts.items()}
        rows |= {f"{name}: {view}": to_uint8(each[:, :, index]) for view, each in masked.items()}
    return {label: row.cpu() for label, row in rows.items()}


def picture_objects(
    folder: str | Path,
    records: TensorDictBase,
    views: Mapping[str, TensorDictBase],
    context: int,
    names: Sequence[str],
    *,
    write: WriteVideo = write_video,
) -> None:
    """Write ``objects.mp4`` and ``objects.png``; takes what :func:`object_rows` and :func:`draw_objects` take."""
    rows = object_rows(records, views, names)
    write(Path(folder) / "objects.mp4", tile(list(rows.values())), scale=2)  # one sequence per column
    draw_objects(Path(folder) / "objects.png", rows, context)


def draw_objects(path: str | Path, rows: dict[str, Tensor], context: int, *, frames: int = 6) -> None:
    """Draw a few frames of the first sequence of :func:`object_rows`, one per column, the last seen one first.

    Args:
        path: PNG file to write.
        rows: What it is → ``[N, T, 3, H, W]`` uint8.
        context: Frames that are seen before the rest is imagined.
        frames: How many.
    """
    length = next(iter(rows.values())).shape[1]
    times = torch.linspace(context - 1, length - 1, frames).long().tolist()
    size, gaps = (1.4 * frames, 1.4 * len(rows)), {"wspace": 0.04, "hspace": 0.04}
    figure, axes = plt.subplots(len(rows), frames, figsize=size, squeeze=False, gridspec_kw=gaps)
    for line, (label, row) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(label.replace(": ", "\n"), rotation=0, ha="right", va="center")
        for axis, time in zip(line, times, strict=True):
            axis.imshow(row[0, time].permute(1, 2, 0).numpy())
            axis.set(xticks=[], yticks=[])
    for axis, time in zip(axes[0], times, strict=True):
        axis.set_title("last seen" if time < context else f"step {time - context + 1}")
    save_figure(figure, path)


def draw_errors(path: str | Path, errors: dict[str, dict[str, Tensor]], names: Sequence[str]) -> None:
    """Draw what :func:`~torchrl_ocwm.evaluation.objects.object_errors` found, step by step, one column per object.

    Args:
        path: PNG file to write.
        errors: ``filtered``, ``imagined`` and ``unmoved``, each with curves ``[O, steps]``.
        names: Names of the O objects.
    """
    panels = {"median": "position error, cm", "mask_overlap": "mask IoU"}
    found = [key for key in panels if key in errors["imagined"]]
    size = (4.6 * len(names), 3.2 * len(found))
    figure, axes = plt.subplots(len(found), len(names), figsize=size, squeeze=False, layout="constrained")
    for line, key in zip(axes, found, strict=True):
        for index, (axis, name) in enumerate(zip(line, names, strict=True)):
            for view, curves in errors.items():
                _curve(axis, {kind: values[index].cpu() for kind, values in curves.items()}, key, view)
            axis.set(title=name, xlabel="steps after the last seen frame", ylabel=panels[key])
            axis.set_ylim(bottom=0)
            axis.grid(alpha=0.3)
            axis.legend()
    save_figure(figure, path)


def _curve(axis: plt.Axes, curves: dict[str, Tensor], key: str, view: str) -> None:
    scale = 100 if key == "median" else 1
    steps = torch.arange(1, len(curves[key]) + 1)
    axis.plot(steps, scale * curves[key], color=_STYLES[view], label=view)
    if key == "median":
        axis.fill_between(steps, scale * curves["lower"], scale * curves["upper"], color=_STYLES[view], alpha=0.15)


def draw_goal_latents(path: str | Path, pairs: dict[str, tuple[Tensor, Tensor]], positions: Tensor) -> None:
    """Draw how the cosine of a goal latent and another latent falls with the distance of their positions.

    Args:
        path: PNG file to write.
        pairs: Goal and other → latents ``[K, L]`` of both (:func:`~torchrl_ocwm.evaluation.goal_latents.latent_pairs`).
        positions: ``[K, D]`` metres, of both.
    """
    apart = 100 * distances(positions).cpu()
    own = torch.eye(len(positions), dtype=torch.bool)
    figure, axes = plt.subplots(
        1, len(pairs), figsize=(4 * len(pairs), 3.4), squeeze=False, sharey=True, layout="constrained"
    )
    for axis, (name, (goals, latents)) in zip(axes[0], pairs.items(), strict=True):
        similarity = cosines(goals, latents).cpu()
        axis.scatter(apart[~own], similarity[~own], s=2, alpha=0.15, linewidths=0, label="of another frame")
        axis.scatter(apart[own], similarity[own], s=8, color="C3", linewidths=0, label="of the same frame")
        axis.set(title=name.replace(", ", " goal – latent of "), xlabel="distance of the positions, cm")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("cosine")
    axes[0, 0].legend(markerscale=2)
    save_figure(figure, path)
