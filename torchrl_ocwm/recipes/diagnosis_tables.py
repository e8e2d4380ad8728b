"""What a diagnosis prints."""

from __future__ import annotations

import math

from torch import Tensor

GOALS = {
    "cosine": ("cosine", 3),
    "cosine_with_others": ("cosine with others", 3),
    "contrast": ("contrast", 3),
    "median_rank": ("median rank", 1),
    "mean_rank": ("mean rank", 2),
    "ranked_first": ("ranked first", 2),
    "distance": ("distance of the best match, m", 4),
    "distance_to_others": ("distance of others, m", 4),
}


def error_table(errors: dict[str, dict[str, Tensor]], names: tuple[str, ...]) -> str:
    """Rows: object, view and a few steps; columns: overlap of masks, median and quartiles of the position error."""
    if not errors["imagined"]:
        return ""
    steps = next(iter(errors["imagined"].values())).shape[-1]
    shown = sorted({1, math.ceil(steps / 3), steps})
    lines = ["| object | view | step | mask IoU | position error, m | quartiles |", "|---|---|---|---|---|---|"]
    for index, name in enumerate(names):
        for view, curves in errors.items():
            for step in shown:
                at = {key: float(values[index, step - 1]) for key, values in curves.items()}
                overlap = f"{at['mask_overlap']:.2f}" if "mask_overlap" in at else "–"
                error = f"{at['median']:.4f} | {at['lower']:.4f} to {at['upper']:.4f}" if "median" in at else "– | –"
                lines.append(f"| {name} | {view} | {step} | {overlap} | {error} |")
    return "\n".join(lines)


def goal_table(goals: dict[str, dict[str, float]]) -> str:
    """Rows: what goal latents are compared with; columns: how well they match."""
    if not goals:
        return ""
    titles = [title for title, _ in GOALS.values()]
    lines = ["| goal, compared with | " + " | ".join(titles) + " |", "|---|" + "---|" * len(titles)]
    for name, values in goals.items():
        cells = [f"{values[key]:.{digits}f}" for key, (_, digits) in GOALS.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
