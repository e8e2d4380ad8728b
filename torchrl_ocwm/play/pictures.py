"""Pictures with marks on them, as HTML that holds all it needs."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO

import numpy as np
from PIL import Image

from torchrl_ocwm.play.places import Point
from torchrl_ocwm.play.session import View

_COLOURS = np.array([(255, 210, 60), (80, 170, 255), (255, 120, 200), (120, 230, 120)], np.float32)
_QUALITY = 85


def camera_picture(view: View) -> str:
    """The camera with the workspace, the goal, and where the world model believes the object to be."""
    label = "Live camera. Click to set the goal, drag an object to move it."
    return picture(view.camera, label, {"goal": view.goal, "believed": view.believed}, view.workspace)


def imagined_picture(view: View) -> str:
    """What the agent imagined; a text if it imagines nothing."""
    if view.imagined is None:
        return _nothing("A scripted policy imagines nothing.")
    return picture(view.imagined, "Imagined by the agent", {"goal": view.goal, "expected": view.expected})


def masks_picture(view: View) -> str:
    """The masks that the world model sees, in the colours of the objects, over what there is; a text if it has none."""
    if view.masks is None:
        return _nothing("There are no decoded masks: this agent has no object-centric world model.")
    return picture(tinted(view.seen, view.masks), "Decoded masks", {})


def numbers(view: View) -> str:
    """Distance and scores, as HTML."""
    values = {
        "distance": ("distance", None if view.distance is None else f"{100 * view.distance:.1f} cm"),
        "score": ("score now", None if view.score is None else f"{view.score:.2f}"),
        "mean-score": ("mean score", None if view.mean_score is None else f"{view.mean_score:.2f}"),
        "steps": ("steps", str(view.steps)),
    }
    parts = [f'<div><dt>{name}</dt><dd id="{key}">{value or "–"}</dd></div>' for key, (name, value) in values.items()]
    return f'<dl class="numbers">{"".join(parts)}</dl>'


def tinted(pixels: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """A darkened image with masks in colours.

    Args:
        pixels: ``[H, W, 3]`` uint8.
        masks: ``[O, H, W]`` in [0, 1].

    Returns:
        ``[H, W, 3]`` uint8.

    Examples:
        >>> tinted(np.full((1, 2, 3), 100, np.uint8), np.array([[[0.0, 1.0]]]))[0].tolist()
        [[50, 50, 50], [255, 210, 60]]
    """
    image = 0.5 * pixels.astype(np.float32)
    for number, mask in enumerate(masks[..., None]):
        image = (1 - mask) * image + mask * _COLOURS[number % len(_COLOURS)]
    return image.clip(0, 255).astype(np.uint8)


def picture(pixels: np.ndarray, label: str, marks: Mapping[str, Point | None], outline: Sequence[Point] = ()) -> str:
    """An image with marks, as HTML.

    Args:
        pixels: ``[H, W, 3]`` uint8.
        label: What it is, for those who do not see it.
        marks: Kind of mark → its place, (column, row) from 0 to 1; ``None`` for one that is not drawn.
        outline: Corners of a line around something.
    """
    corners = " ".join(f"{column:.4f},{row:.4f}" for column, row in outline)
    lines = [f'<polygon class="workspace{more}" points="{corners}"/>' for more in (" halo", "") if corners]
    lines += [_mark(kind, *place) for kind, place in marks.items() if place is not None]
    drawing = f'<svg viewBox="0 0 1 1" preserveAspectRatio="none" aria-hidden="true">{"".join(lines)}</svg>'
    return f'<div class="picture"><img alt="{escape(label)}" draggable="false" src="{_data(pixels)}">{drawing}</div>'


def _mark(kind: str, column: float, row: float) -> str:
    """A cross for the goal, a ring for all else; each twice, so that it shows on dark and on bright ground."""
    ring = f'cx="{column:.4f}" cy="{row:.4f}" r="0.022"'
    cross = f'd="M{column - 0.025:.4f} {row:.4f}h.05M{column:.4f} {row - 0.025:.4f}v.05"'
    shape = f"path {cross}" if kind == "goal" else f"circle {ring}"
    return "".join(f'<{shape} class="{name}"/>' for name in ("halo", kind))


def _data(pixels: np.ndarray) -> str:
    """An image as an address that holds it. Small ones are kept exactly."""
    kind, options = ("png", {}) if len(pixels) <= 128 else ("jpeg", {"quality": _QUALITY})
    with BytesIO() as file:
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, kind, **options)
        return f"data:image/{kind};base64,{b64encode(file.getvalue()).decode()}"


def _nothing(text: str) -> str:
    return f'<p class="nothing">{escape(text)}</p>'
