"""What the page of exploration says is in the files beside it."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from reading import RESULTS, cell, missing, page, report, unchecked

from torchrl_ocwm.evidence import Evidence, results

NAME = "exploration"
SHOWN = {
    "random": "smooth random actions",
    "scripted": "the script",
    "plan2explore": "Plan2Explore",
    "focus_explore": "FOCUS",
}
#: What was done: no file beside the page has these numbers.
STATED = [
    "Reacher at commit 45c8d50 and Cube move at commit e41df8a",
    "PyTorch 2.13.0 on the CPU",
    "in 1,000 random steps",
    "at commits abd9e81 and 19083c4 on 2026-11-28 on such a machine: 66 minutes",
    "there too, at commit 19083c4: 80 minutes",
]
ENVIRONMENTS = {"reacher": "REACHER", "cube_move": "CUBE"}


def last(env: str) -> dict[str, Any]:
    """The last point of each curve, and the steps there."""
    curves = json.loads((RESULTS / NAME / env / "results.json").read_text())
    return {name: {**curve[max(curve, key=int)], "steps": max(map(int, curve))} for name, curve in curves.items()}


def measured(env: str, digits: dict[str, int]) -> list[str]:
    points = last(env)
    script = (RESULTS / NAME / "run.sh").read_text()
    ratio = float(re.findall(r"RATIO:-([\d.]+)", script)[0])
    steps, seed_steps = (int(one) for one in re.findall(rf"{ENVIRONMENTS[env]}_STEPS:-(\d+)}}\" 100 (\d+)", script)[0])
    updates = round(100 + ratio * (steps - seed_steps))
    return [
        f"{steps:,} steps each; the explorers' first {seed_steps:,} are random",
        f"{updates:,} updates",
        *(
            f"{shown}: {points[name]['visited']:.0%} and {points[name]['moves']:.{digits.get(name, 0)}%}"
            for name, shown in SHOWN.items()
        ),
    ]


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_table(env: str) -> None:
    table = (RESULTS / NAME / env / "results.md").read_text().strip()
    assert table in (RESULTS / NAME / "README.md").read_text()
    for name, point in last(env).items():
        assert f"| {name} | {point['steps']:,} | {point['visited']:.0%} | {point['moves']:.0%} |" in table


def learnt() -> list[str]:
    """How FOCUS + LCP does on the data of each."""
    found = report("figures/exploration-reacher-cpu/reacher")
    steps = json.loads((RESULTS / "figures/exploration-reacher-cpu/runs.json").read_text())
    work = {record["work"] for name, record in steps.items() if name.startswith("datasets/")}
    assert len(work) == 1
    scores = {name: cell(found, f"focus_lcp on {name}", "final_score") for name in SHOWN}
    first, *others = (f"of {shown} it scores {scores[name]}" for name, shown in SHOWN.items())
    return [f"on {work.pop():,} steps {first}", *(one.replace("it scores ", "") for one in others)]


def longer() -> list[str]:
    """FOCUS on Cube move: the cube moves among the random steps, and hardly ever again."""
    folder = RESULTS / NAME / "cube_move_focus"
    total, first, moved, _ = motion("cube_move_focus")
    records = json.loads((RESULTS / "figures/exploration-reacher-cpu/runs.json").read_text(encoding="utf-8"))
    (online,) = (one["content"]["online"] for name, one in records.items() if "-focus_explore-" in name)
    assert (online["seed_steps"], online["update_ratio"]) == ([5000], 0.1)
    wanted = Evidence(figure="exploration", env="cube_move", seeds=1, agents=("focus_lcp on focus_explore",))
    (one,) = results(wanted)
    assert f"made=outputs/evidence/{one.evaluated.trained.data.name} " in page(NAME)
    for name in ("results", "gripper"):
        assert (folder / f"{name}.md").read_text(encoding="utf-8") in (RESULTS / NAME / "README.md").read_text(
            encoding="utf-8"
        )
    assert total == online["steps"]
    return [
        f"{total:,} steps, the first 5,000 of them random",
        f"It moves in {first} of the first 5,000 steps, and in {moved} of the {total - 5000:,} after that",
    ]


def fruitless() -> list[str]:
    """FOCUS + LCP on FOCUS's data of Cube move."""
    found = report("figures/exploration-cube_move-cpu/cube_move")
    row = "focus_lcp on focus_explore"
    score, image_score, random = (cell(found, name, "final_score") for name in (row, f"{row}, image goals", "random"))
    end, imagined = (cell(found, row, metric) for metric in ("final_distance", "imagined_distance"))
    assert (len(found.goals), len(found.rows[row].runs)) == (100, 1)
    records = json.loads((RESULTS / "figures/exploration-cube_move-cpu/runs.json").read_text(encoding="utf-8"))
    (trained,) = (one for name, one in records.items() if name.startswith("trainings/"))
    return [
        f"After {trained['work']:,} updates on this dataset it scores {score} with positions and {image_score} "
        f"with images, random actions {random} ([100 goals, one seed]",
        f"on average it ends {end} m from the goal, and imagines {imagined}",
    ]


def motion(folder: str) -> tuple[int, int, int, str]:
    """Steps; in how many of the first 5,000 and of the others the cube moves; the share of the workspace it visits."""
    curve = json.loads((RESULTS / NAME / folder / "results.json").read_text(encoding="utf-8"))["focus_explore"]
    moved = {int(steps): round(int(steps) * one["moves"]) for steps, one in curve.items()}
    steps = max(moved)
    return steps, moved[5000], moved[steps] - moved[5000], f"{curve[str(steps)]['visited']:.0%}"


def own_model() -> list[str]:
    """The explorer in the world model of FOCUS + LCP."""
    written = (RESULTS / NAME / "README.md").read_text(encoding="utf-8")
    for file in ("results.md", "gripper.md"):
        assert (RESULTS / NAME / "cube_move_own" / file).read_text(encoding="utf-8") in written
    steps, first, moved, visited = motion("cube_move_own")
    alone = motion("cube_move_focus")
    assert (steps, first) == alone[:2]
    return [
        f"it moves in {moved} of the {steps - 5000:,} steps after the random ones, "
        f"where FOCUS alone moved it in {alone[2]}",
        f"It has been in {visited} of the workspace, where it had been in {alone[3]}",
        f"the script moves the cube in {last('cube_move')['scripted']['moves']:.0%} of the steps",
    ]


def entropies(folder: str) -> list[dict[str, str]]:
    """Group of frames → the entropy of the cube's latent, for each world model."""
    shown = (RESULTS / NAME / folder / "entropy.md").read_text(encoding="utf-8")
    assert shown in (RESULTS / NAME / "README.md").read_text(encoding="utf-8")
    found = json.loads((RESULTS / NAME / folder / "entropy.json").read_text(encoding="utf-8"))
    return [{group: f"{one['cube']:.2f}" for group, one in groups.items()} for groups in found.values()]


def paid() -> list[str]:
    """What the reward pays for, model by model; the explorers' in their own frames too."""
    moved, low, high, hidden = (
        "cube moved",
        "cube at its start, gripper low",
        "cube at its start, gripper high",
        "cube hidden",
    )
    (alone,), (own,) = entropies("cube_move_focus"), entropies("cube_move_own")
    focus, _, pcp, lcp = entropies("entropy")
    assert own[hidden] == max(own.values())
    return [
        f"It is higher where the gripper is high**: {alone[high]}, where it is low {alone[low]}",
        f"pays {focus[high]} where the gripper is high, {focus[low]} where it is low, "
        f"and {focus[moved]} where the cube has moved",
        f"would pay {pcp[moved]} where the cube has moved, and {pcp[low]} or {pcp[high]} where it has not",
        f"tells them apart best: {lcp[moved]} against {lcp[low]} and {lcp[high]}",
        f"a high gripper pays less than a low one, {own[high]} against {own[low]}, "
        f"and hiding the cube pays most, {own[hidden]}",
    ]


def test_page() -> None:
    rare = {"random": 1, "scripted": 1, "plan2explore": 2, "focus_explore": 2}
    cube_move = [*measured("cube_move", rare), *longer(), *fruitless(), *own_model(), *paid()]
    sentences = [*measured("reacher", {}), *cube_move, *learnt(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
