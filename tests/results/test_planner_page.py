"""What the page of planner and policy says is in the files beside it."""

from __future__ import annotations

import math

from reading import mean, missing, report, settings, unchecked

NAME = "reacher/planner"
#: What was done: no file beside the page has these numbers.
STATED = ["At commit b6f52b5", "PyTorch 2.13.0 on the CPU"]


def measured() -> list[str]:
    numbers = report(NAME)
    given = numbers.settings
    goals, horizon, candidates, drawn = len(numbers.goals), given["horizon"], given["candidates"], given["iterations"]
    planner, policy = (mean(numbers, name, "final_distance", 1000) for name in ("planner", "policy"))
    updates = settings("reacher/visual_goals", "focus_lcp_seed_0")["training"]["updates"]
    return [
        f"{goals} goals, a {math.isqrt(goals)} × {math.isqrt(goals)} grid over what the arm can reach; "
        f"{given['steps']} steps each",
        f"looks {horizon} steps ahead, with {candidates} candidates that are drawn {drawn} times",
        f"The planner stops {planner:.0f} mm from its goals, the policy {policy:.0f} mm",
        f"has learnt in {updates:,} updates",
        f"With {goals} goals and one seed",
        f"it imagines {horizon} × {drawn} steps of {candidates} candidates",
        f"with {updates:,} updates, with positions",
    ]


def test_page() -> None:
    sentences = [*measured(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
