"""What the page of goals as images says is in the files beside it."""

from __future__ import annotations

import math
import re

from reading import RESULTS, mean, missing, report, settings, unchecked

NAME = "reacher/visual_goals"
AGENTS = {"focus_lcp": "FOCUS + LCP", "lexa_cosine": "LEXA cosine", "lexa_temporal": "LEXA temporal"}
#: What was done: no file beside the page has these numbers.
STATED = ["At commit 45c8d50, and seed 1 and the evaluation at commit e41df8a", "PyTorch 2.13.0 on the CPU"]


def protocol() -> list[str]:
    """How the runs were made."""
    numbers = report(NAME)
    runs = [settings(NAME, file.stem)["training"] for file in (RESULTS / NAME).glob("*_seed_*.yaml")]
    (updates,) = {run["updates"] for run in runs}
    (steps,) = re.findall(r"steps=(\d+)", (RESULTS / NAME / "run.sh").read_text())
    assert {run["seed"] for run in runs} == {0, 1}
    side, each = math.isqrt(len(numbers.goals)), numbers.settings["episode_steps"]
    return [
        f"the same {int(steps):,} steps of data, {updates:,} updates",
        f"{len(numbers.goals)} goals, a {side} × {side} grid over what the arm can reach; {each} steps each",
    ]


def measured() -> list[str]:
    """Scores and distances with images as goals."""
    numbers = report(NAME)
    images = {agent: f"{agent}, image goals" for agent in AGENTS}
    sentences = [
        f"**{shown} scores {mean(numbers, images[agent], 'final_score'):.2f} and ends "
        f"{mean(numbers, images[agent], 'final_distance', 100):.1f} cm from its goals"
        for agent, shown in AGENTS.items()
    ]
    lost = mean(numbers, "focus_lcp", "final_score") - mean(numbers, images["focus_lcp"], "final_score")
    imagined = mean(numbers, images["lexa_temporal"], "imagined_distance", 100)
    return [
        *sentences,
        f"would add is {lost:.2f}",
        f"within 5 cm of {mean(numbers, images['focus_lcp'], 'success'):.0%} of them",
        f"within 5 cm of {mean(numbers, images['lexa_cosine'], 'success'):.0%} of its goals",
        f"random actions ({mean(numbers, 'random', 'final_score'):.2f})",
        f"expects to end {imagined:.1f} cm off",
    ]


def shape_of_rewards() -> list[str]:
    """Rows and sentences of what the two scripts beside the page printed."""
    shapes, printed = ((RESULTS / NAME / f"{name}.md").read_text() for name in ("reward_shape", "temporal_distance"))
    explained, *lines = printed.splitlines()
    horizon = settings(NAME, "lexa_temporal_seed_0")["size"]["learning"]["imagination_horizon"]
    updates = settings(NAME, "lexa_temporal_seed_0")["training"]["updates"]
    rewarded = dict(zip(cells(lines[1]), cells(lines[3]), strict=True))
    far = float(rewarded["other sequences"])
    assert far - float(rewarded["15 steps"]) <= 0.1  # "almost"
    return [
        *shapes.splitlines()[2:],
        *lines[1:],
        f"its horizon of {horizon} steps",
        f"one imagined rollout, {horizon} steps at most",
        "Beyond 15 steps it says almost what it says of other sequences",
        f"The head explains {explained.split()[3]} of the variance of those after {updates:,} updates",
        f"said to be {rewarded['0 steps']} of the horizon away, and two steps off it is {rewarded['2 steps']}",
    ]


def cells(line: str) -> list[str]:
    """Those of a row of a table."""
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_page() -> None:
    sentences = [*measured(), *protocol(), *shape_of_rewards(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
