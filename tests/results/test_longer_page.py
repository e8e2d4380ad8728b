"""What the page of Dreamer's longer runs says is in the files beside it."""

from __future__ import annotations

import pytest
from reading import RESULTS, curve, mean, missing, report, settings, unchecked

NAME = "reacher/longer"
RUNS = {"goal_weight_100": "dreamer, goal weight 100", "target_12": "dreamer, target of 12 pixels"}
#: What was done: no file beside the page has these numbers.
STATED = [
    "On 2026-11-27, at commit 4d2e5e5",
    "PyTorch 2.13.0 on the CPU",
    "1,500 updates",
    "100 goals, 150 steps each; one seed",
    "**A disc of 12 pixels at the goal**",
    "**A goal position with a weight of 100**",
    "Dreamer with a goal that weighs 1 (and the entity 200) and no disc",
    "all weights 1",
    "all runs have there",
    "(1: all of it)",
    "the last of 16 frames",
    "the last 10 are imagined",
]


def before(name: str) -> float:
    """The final score of the run that was a fourth as long."""
    figure = "loss_scale" if name == "goal_weight_100" else "target_size"
    return mean(report(f"figures/{figure}-reacher-cpu/reacher"), RUNS[name], "final_score")


def said(name: str) -> list[str]:
    made, scores = settings(f"{NAME}/{name}", "seed_0"), curve(RESULTS / NAME / name / "seed_0.csv")
    assert max(scores) == made["training"]["updates"] == 6000
    (found,) = report(f"{NAME}/{name}").rows
    final = mean(report(f"{NAME}/{name}"), found, "final_score")
    rounds = ", ".join(f"{scores[at]:.2f}" for at in (1800, 2400, 3600, 4800))
    return [
        f"final score is {final:.2f} after 6,000 updates, where it was {before(name):.2f} after 1,500",
        f"{rounds} and {scores[6000]:.2f} after 1,800, 2,400, 3,600, 4,800 and 6,000 updates",
    ]


def elsewhere() -> list[str]:
    """What other pages say, to compare with."""
    plain, weights = report("reacher"), settings("reacher", "dreamer_seed_0")
    pcp = mean(report("figures/table-reacher-cpu/reacher"), "dreamer_pcp", "final_score")
    return [
        f"has {mean(plain, 'dreamer', 'final_score'):.3f} after {weights['training']['updates']:,} updates",
        f"has {pcp:.2f} after 1,500 updates",
    ]


def test_page() -> None:
    sentences = [*(sentence for name in RUNS for sentence in said(name)), *elsewhere(), *STATED]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []


@pytest.mark.parametrize("name", RUNS)
def test_tables(name: str) -> None:
    text = (RESULTS / NAME / "README.md").read_text()
    assert report(f"{NAME}/{name}").markdown() in text
    row = (RESULTS / NAME / name / "reward.md").read_text().splitlines()[-1].split(" | ", 1)[1]
    assert row in text
