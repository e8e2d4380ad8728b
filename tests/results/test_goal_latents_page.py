"""What the page of goal latents says is in the figure and the table of the script beside it."""

from __future__ import annotations

import pytest
from reading import RESULTS, cell, mean, missing, report, unchecked

NAME = "reacher/goal_latents"
FIGURE = "figures/goal_latents-reacher-cpu/reacher"
#: What the page says of each row of the figure.
ROWS = {
    "focus_lcp": "both | 100 | plain",
    "focus_lcp, centred latents": "both | 100 | centred",
    "focus_lcp, weight from 100 to 1": "both | from 100 to 1 | plain",
    "focus_lcp, weight 1": "both | 1 | plain",
    "focus_lcp, only the encoder learns": "the encoder | – | plain",
    "focus_lcp, only the encoder learns, centred latents": "the encoder | – | centred",
}
STATED = ["Reacher, 1,500 updates, 100 goals, one seed", "beside those of 100 frames", "On 2026-11-27"]


def latents() -> dict[str, list[float]]:
    lines = (RESULTS / NAME / "contrast.md").read_text().splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {name: [float(number) for number in numbers] for name, *numbers in rows}


@pytest.mark.parametrize("name", ROWS)
def test_scores(name: str) -> None:
    found = report(FIGURE)
    scores = [mean(found, row, "final_score") for row in (name, f"{name}, image goals")]
    text = (RESULTS / NAME / "README.md").read_text()
    assert f"| {ROWS[name]} | {scores[0]:.2f} | {scores[1]:.2f} |" in text
    assert len(found.rows[name].runs) == 1


def test_page() -> None:
    text = (RESULTS / NAME / "README.md").read_text()
    assert (RESULTS / NAME / "contrast.md").read_text() in text
    found = latents()
    heavy, others = found["focus_lcp"], [row for name, row in found.items() if name != "focus_lcp"]
    error = cell(report("figures/table-reacher-cpu/reacher"), "focus_lcp", "final_score").split(" ± ")[1]
    nearest = min(row[4] for row in others)
    assert all(row[2] > heavy[2] for row in others)
    sentences = [
        f"The standard error of the first row is {error} with three seeds",
        f"With a weight of 100 the latents of all places are alike ({heavy[1]:.3f}), and yet the best match is "
        f"{heavy[4]:.0f} mm from the goal; with more contrast it is {nearest:.0f} mm or more",
        "Less than with a weight of 1",
        *STATED,
    ]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
