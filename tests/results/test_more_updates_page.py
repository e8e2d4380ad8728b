"""What the page of Cube move with more updates says is in the files beside it."""

from __future__ import annotations

import json
from pathlib import Path

from reading import RESULTS, curve, mean, missing, report, settings, unchecked

NAME = "cube_move/more_updates"
HERE = RESULTS / NAME
BEFORE = f"{NAME}/7500/cube_move"
TABLE = "figures/table-cube_move-cpu/cube_move"
#: What was done: no file beside the page has these numbers.
STATED = [
    "**After 7,500 updates on it, an agent that does not act itself hardly moves the cube; after 15,000 it does.**",
    "15,000 updates, going on from the others",
    "7,500 updates ([the figure's page]",
    "[15,000 updates](results.json), [7,500]",
    "![final score over the workspace after 15,000 updates]",
    "After 15,000 updates it",
    "On 2026-11-27, at commit 22a91c2",
    "the data at commit 687113b",
    "PyTorch 2.13.0 on the CPU",
    "After 25,000 scripted and random steps",
    "more than the 50,000 asked for",
    "when the run of 7,500 updates was made longer",
    "not quite a run of 15,000 from the start",
]


def curves() -> list[str]:
    scores = curve(HERE / "focus_pcp_seed_0.csv")
    assert max(scores) == settings(NAME, "focus_pcp_seed_0")["training"]["updates"] == 15000
    said = ", ".join(f"{scores[at]:.2f}" for at in (6000, 7500, 9000, 10500, 12000, 13500))
    other = curve(HERE / "focus_lcp_seed_0.csv")
    assert max(other) == 10500
    later = ", ".join(f"{other[at]:.2f}" for at in (7500, 9000, 9750))
    return [
        f"{said} and {scores[15000]:.2f} after 6,000, 7,500, 9,000, 10,500, 12,000, 13,500 and 15,000 updates",
        f"{later} and {other[10500]:.2f} after 7,500, 9,000, 9,750 and 10,500",
    ]


def collected() -> list[str]:
    metres = [-100 * value for value in curve(HERE / "collected_reward.csv").values()]
    rounds = ", ".join(f"{value:.0f}" for value in metres[:-1])
    steps = max(curve(HERE / "collected_steps.csv").values())
    assert len(metres) == 5
    return [f"{rounds} and {metres[-1]:.0f} cm from the goal in its five rounds", f"{steps:,.0f} steps in all"]


def longer() -> list[str]:
    """Twice as long from the start, and the same seed of the table."""
    twice, table = (report(name).rows["focus_pcp"] for name in (f"{NAME}/30000/cube_move", TABLE))
    assert (len(twice.seeds), twice.seeds[0]["final_score"].shape) == (1, (100,))
    score, before = (float(row.seeds[0]["final_score"].mean()) for row in (twice, table))
    success, less = (float(row.seeds[0]["success"].mean()) for row in (twice, table))
    readme = " ".join((RESULTS.parents[1] / "README.md").read_text().split())
    assert f"with twice as many, `focus_pcp` has {score:.2f} ([one seed]" in readme
    return [
        f"on the same data: {score:.2f} after 30,000 updates**, where the same seed has {before:.2f} after 15,000",
        f"within 5 cm of {success:.0%} of the goals, not of {less:.0%}",
        "([the figure's page](30000/README.md), one seed)",
    ]


def test_page() -> None:
    before, after = report(BEFORE), report(NAME)
    scores = [mean(one, "focus_pcp", "final_score") for one in (before, after)]
    lcp = [mean(before, row, "final_score") for row in ("focus_lcp", "focus_lcp, image goals", "random")]
    believed, real = (mean(after, "focus_pcp", name, 100) for name in ("imagined_distance", "final_distance"))
    sentences = [
        f"final score is {scores[0]:.2f} after 7,500 updates and **{scores[1]:.2f}** after 15,000",
        f"FOCUS + LCP has {lcp[0]:.2f} after 7,500, with images {lcp[1]:.2f}, random actions {lcp[2]:.2f}",
        f"expects to end {believed:.1f} cm from the goal, and ends {real:.1f} cm from it",
        f"{len(after.goals)} goals, {after.settings['episode_steps']} steps each; one seed",
        *longer(),
        *curves(),
        *collected(),
        *STATED,
    ]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []


def test_tables() -> None:
    text = (HERE / "README.md").read_text()
    for one in (BEFORE, NAME):
        assert report(one).markdown() in text


def test_the_page_of_before_is_whole() -> None:
    runs = json.loads((HERE / "7500" / "runs.json").read_text())
    assert sorted(Path(name).parent.name for name in runs) == ["datasets", *["evaluations"] * 2, *["trainings"] * 2]
