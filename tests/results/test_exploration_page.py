"""What the page of exploration says is in the files beside it."""

from __future__ import annotations

import json
import re
from typing import Any

from reading import RESULTS, missing, unchecked

NAME = "exploration"
SHOWN = {
    "random": "smooth random actions",
    "scripted": "the script",
    "plan2explore": "Plan2Explore",
    "focus_explore": "FOCUS",
}
#: What was done: no file beside the page has these numbers.
STATED = ["At commit 45c8d50", "PyTorch 2.13.0 on the CPU"]


def last() -> dict[str, Any]:
    """The last point of each curve, and the steps there."""
    curves = json.loads((RESULTS / NAME / "reacher" / "results.json").read_text())
    return {name: {**curve[max(curve, key=int)], "steps": max(map(int, curve))} for name, curve in curves.items()}


def measured() -> list[str]:
    points = last()
    script = (RESULTS / NAME / "run.sh").read_text()
    ratio = float(re.findall(r"RATIO:-([\d.]+)", script)[0])
    steps, seed_steps = (int(one) for one in re.findall(r"REACHER_STEPS:-(\d+)}\" 100 (\d+)", script)[0])
    updates = round(100 + ratio * (steps - seed_steps))
    return [
        f"{steps:,} steps each; the explorers' first {seed_steps:,} are random",
        f"{updates:,} updates",
        *(f"{shown}: {points[name]['visited']:.0%} and {points[name]['moves']:.0%}" for name, shown in SHOWN.items()),
    ]


def test_table() -> None:
    table = (RESULTS / NAME / "reacher" / "results.md").read_text().strip()
    assert table in (RESULTS / NAME / "README.md").read_text()
    for name, point in last().items():
        assert f"| {name} | {point['steps']:,} | {point['visited']:.0%} | {point['moves']:.0%} |" in table


def test_page() -> None:
    sentences = [*measured(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
