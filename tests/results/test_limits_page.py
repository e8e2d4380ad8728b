"""What the page of the virtual target on Cube move says is in the files beside it."""

from __future__ import annotations

import pytest
from reading import RESULTS, mean, missing, report, unchecked

NAME, FIGURE = "cube_move/limits", "figures/limits-cube_move-cpu/cube_move"
ROWS = [f"{agent}, weights {weight}" for agent in ("dreamer", "focus") for weight in (1, 200)]
#: What was done: no file beside the page has these numbers.
STATED = [
    "On 2026-11-27, at commit 4e4cb4b (what they imagine: 6f41091)",
    "PyTorch 2.13.0 on the CPU",
    "15,000 updates; 100 goals, one seed",
    "a disc of five pixels",
    "Dreamer with weights of 1 deceives itself",
    "With weights of 1 the disc is seen",
    "Dreamer with weights of 200, and FOCUS, know",
    "(1: all of it)",
    "the last of 16 frames",
    "the last 10 are imagined",
    "1, 20 and 100 steps, 16 goals",
    "after 1 and after 20 steps, the agent imagines the 10 steps",
    "in metres, 16 goals",
]


def printed(kind: str, how: str) -> dict[str, list[float]]:
    """Row → the numbers that a script printed."""
    lines = (RESULTS / NAME / f"{kind}_{how}.md").read_text().splitlines()[2:]
    cells = (line.split(" | ", 1)[1].rstrip(" |").split(" | ") for line in lines)
    return {row: [float(one) for one in line] for row, line in zip(ROWS, cells, strict=True)}


def scores() -> list[str]:
    found, table = report(FIGURE), report("figures/table-cube_move-cpu/cube_move")
    assert {len(row.seeds) for row in found.rows.values()} == {1}
    said = []
    for row in ROWS:
        without, disc = (mean(found, f"{row}, {at}", "final_score") for at in ("no target", "virtual target"))
        said.append(f"{without:.2f} without and {disc:.2f} with it")
    one, other = (float(seed["final_score"].mean()) for seed in table.rows["focus, weights 1"].seeds)
    ends = [mean(found, row, "final_distance", 100) for row in found.rows if not row.startswith("dreamer, weights 1,")]
    goal = [mean(found, f"dreamer, weights 1, {at}", "goal_error", 100) for at in ("no target", "virtual target")]
    return [
        f"Dreamer with weights of 1 has {said[0]}, with weights of 200 {said[1]}.",
        f"FOCUS with weights of 1 has {said[2]}, with weights of 200 {said[3]}.",
        f"two seeds of FOCUS with weights of 1 differ by {abs(one - other):.2f}",
        f"On average it ends {min(ends):.0f} to {max(ends):.0f} cm from the goal",
        f"the goal {goal[0]:.1f} cm off without the disc and {goal[1]:.1f} cm with it",
    ]


def known() -> list[str]:
    without, disc = printed("reward", "without")[ROWS[0]], printed("reward", "disc")[ROWS[0]]
    first, after = (printed("believed", "disc")[ROWS[0]][3 * at : 3 * at + 3] for at in (0, 1))
    assert after[0] == first[0]
    off = [
        row[3 * at + 2]
        for how in ("without", "disc")
        for name, row in printed("believed", how).items()
        for at in (1, 2)
        if name != ROWS[0]
    ]
    assert max(off) < 0.02
    return [
        f"it predicts {disc[0]:.0%} of the variance, where it predicted {without[0]:.0%}",
        f"In the first step it knows where the cube is, to {100 * first[2]:.1f} cm. After 20 steps the cube is",
        f"where it was, {100 * after[0]:.0f} cm from the goal, and",
        f"Dreamer believes that it is {100 * after[1]:.1f} cm from it",
        f"On recorded frames it knows the cube to {100 * disc[1]:.1f} cm",
        "to 2 cm after 20 and after 100 steps",
    ]


def imagined() -> list[str]:
    """Of the six rows that know where the cube is: after 20 steps, and after the 10 that are imagined."""
    rows = {
        (name, how): (printed("believed", how)[name][3], *printed("imagined", how)[name][4:])
        for how in ("without", "disc")
        for name in ROWS[1:]
    }
    before, fact, believed = list(zip(*rows.values(), strict=True))[:3]
    nearer = [100 * (one - other) for one, other in zip(before, fact, strict=True)]
    blind = 100 * rows.pop((ROWS[2], "without"))[-1]
    assert {round(100 * row[-1]) for row in rows.values()} == {1}
    line = (RESULTS / NAME / "imagined_pcp.md").read_text().splitlines()[2]
    assert f"{line}\n" in (RESULTS / NAME / "README.md").read_text()
    pcp = line.strip("| ").split(" | ")
    return [
        f"After 20 steps each of these six imagines that 10 more bring the cube to {100 * min(believed):.0f} to",
        f"{100 * max(believed):.0f} cm from the goal.",
        f"In fact it then is {100 * min(fact):.0f} to {100 * max(fact):.0f} cm",
        f"has come nearer by {min(nearer):.0f} to {max(nearer):.0f} cm",
        f"it is 1 cm off, only for FOCUS with weights of 1 and no disc {blind:.0f} cm",
        f"imagines {100 * float(pcp[6]):.0f} cm where it then is {100 * float(pcp[5]):.0f} cm",
    ]


def test_page() -> None:
    sentences = [*scores(), *known(), *imagined(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []


@pytest.mark.parametrize("how", ["without", "disc"])
@pytest.mark.parametrize("kind", ["reward", "believed", "imagined"])
def test_tables(kind: str, how: str) -> None:
    text = (RESULTS / NAME / "README.md").read_text()
    for row, line in zip(ROWS, (RESULTS / NAME / f"{kind}_{how}.md").read_text().splitlines()[2:], strict=True):
        name = f"{row}, {'no disc' if how == 'without' else 'disc'}"
        assert f"| {name} | {line.split(' | ', 1)[1]}\n" in text
