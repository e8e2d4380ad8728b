"""What the page of goal latents says is in the figure and the table of the script beside it."""

from __future__ import annotations

import pytest
from reading import RESULTS, cell, mean, missing, report, unchecked

from torchrl_ocwm.evidence import FIGURES

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
    "whose weight is or becomes 1 are of 2026-11-28",
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
    light, light_image, falls, falls_image = (
        f"{mean(found, f'focus_lcp, {weight}{how}', 'final_score'):.2f}"
        for weight in ("weight 1", "weight from 100 to 1")
        for how in ("", ", image goals")
    )
    annealed = next(row for row in FIGURES["goal_latents"].rows if row.name == "focus_lcp, weight from 100 to 1")
    (until,) = (value for name, value in annealed.changes.items() if name.endswith("annealing_updates"))
    return [
        f"{plain} plain and {centred} centred with positions, {image} and {centred_image} with images",
        f"With a weight of 1 it scores {light} and {light_image} there, with one that falls from 100 to 1 in the first "
        f"{until:,} of 15,000 updates {falls} and {falls_image}",
    ]


def test_page() -> None:
    text = (RESULTS / NAME / "README.md").read_text()
    assert (RESULTS / NAME / "contrast.md").read_text() in text
    found = latents()
    heavy, others = found["focus_lcp"], [row for name, row in found.items() if name != "focus_lcp"]
    error = cell(report("figures/table-reacher-cpu/reacher"), "focus_lcp", "final_score").split(" ± ")[1]
    there = latents("contrast_cube_move.md")
    cube_move, light, falls = (there[f"focus_lcp{row}"] for row in ("", ", weight 1", ", weight from 100 to 1"))
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
        f"the best match is {cube_move[4]:.0f} mm from the goal. With a weight of 1, and with one that falls to 1, "
        f"they are less alike ({light[1]:.3f}, {falls[1]:.3f}), and it is {light[4]:.0f} and {falls[4]:.0f} mm from it",
        *STATED,
    ]
    assert missing(NAME, sentences) == []
    assert unchecked(NAME, sentences) == []
