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
STATED = [
    "where two seeds of the plain one differ by more",
    "Reacher, 1,500 updates, 100 goals, one seed",
    "beside those of 100 frames",
    "On 2026-11-27",
]


def latents(file: str = "contrast.md") -> dict[str, list[float]]:
    lines = (RESULTS / NAME / file).read_text().splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {name: [float(number) for number in numbers] for name, *numbers in rows}


@pytest.mark.parametrize("name", ROWS)
def test_scores(name: str) -> None:
    found = report(FIGURE)
    scores = [mean(found, row, "final_score") for row in (name, f"{name}, image goals")]
    text = (RESULTS / NAME / "README.md").read_text()
    assert f"| {ROWS[name]} | {scores[0]:.2f} | {scores[1]:.2f} |" in text
    assert len(found.rows[name].runs) == 1


def on_cube_move() -> list[str]:
    found, table = (report(f"figures/{name}-cube_move-cpu/cube_move") for name in ("goal_latents", "table"))
    names = [f"{name}{how}" for how in ("", ", image goals") for name in ("focus_lcp", "focus_lcp, centred latents")]
    scores = [mean(found, name, "final_score") for name in names]
    one, other = (float(seed["final_score"].mean()) for seed in table.rows["focus_lcp"].seeds)
    assert abs(one - other) > max(scores[1] - scores[0], scores[3] - scores[2]) > 0
    plain, centred, image, centred_image = (f"{score:.2f}" for score in scores)
    light, light_image = (mean(found, f"focus_lcp, weight 1{how}", "final_score") for how in ("", ", image goals"))
    return [
        f"{plain} plain and {centred} centred with positions, {image} and {centred_image} with images",
        f"With a weight of 1 it scores {light:.2f} and {light_image:.2f} there",
    ]


def test_page() -> None:
    text = (RESULTS / NAME / "README.md").read_text()
    assert (RESULTS / NAME / "contrast.md").read_text() in text
    found = latents()
    heavy, others = found["focus_lcp"], [row for name, row in found.items() if name != "focus_lcp"]
    error = cell(report("figures/table-reacher-cpu/reacher"), "focus_lcp", "final_score").split(" ± ")[1]
    cube_move = latents("contrast_cube_move.md")["focus_lcp"]
    assert cube_move[1] > heavy[1]
    nearest = min(row[4] for row in others)
    assert all(row[2] > heavy[2] for row in others)
    sentences = [
        f"The standard error of the first row is {error} with three seeds",
        f"With a weight of 100 the latents of all places are alike ({heavy[1]:.3f}), and yet the best match is "
        f"{heavy[4]:.0f} mm from the goal; with more contrast it is {nearest:.0f} mm or more",
        "Less than with a weight of 1",
        *on_cube_move(),
        f"On Cube move, with a weight of 100, the latents are still more alike ({cube_move[1]:.3f}), and "
        f"the best match is {cube_move[4]:.0f} mm from the goal ([table]",
        *STATED,
    ]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
