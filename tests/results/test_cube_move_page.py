"""What the page of Cube move says is in the files beside it."""

from __future__ import annotations

import json

import pytest
import torch
from reading import RESULTS, ROOT, curve, diagnosis, grid, mean, missing, report, settings, unchecked

#: What was done, or what the paper says: no file beside the page has these numbers.
STATED = [
    "after 100 minutes on two CPU cores",
    "after 250,000 updates of a larger model the paper reports 0.35 ± 0.05 for Dreamer, 0.75 ± 0.04 for FOCUS + PCP "
    "and 0.73 ± 0.05 for FOCUS + LCP",
    "Dreamer has 7,500 on the data that they left",
    "had images of 64 × 64, episodes of 250 steps, scripts without misses, at most two "
    "rounds and 4,000 to 10,000 updates",
    "At commit c1b4e61 on 2026-11-25",
    "28,000 steps of scripted and random actions took 14 minutes",
    "5,000 updates of both agents side by side 24 minutes",
    "3,900 steps by each agent and 2,500 updates of both, 15 to 17 minutes",
    "the cube moves in 35% of 59,500 steps, and visits 100% of the workspace",
    "instead of 5, for lack of time",
    "with the names that settings had in release 0.1",
    "250,000 updates of each agent on some 975,000 steps in the end",
]


def protocol() -> list[str]:
    """How the runs were made."""
    numbers, runs = report("cube_move"), [settings("cube_move", f"focus_{name}_seed_0") for name in ("pcp", "lcp")]
    (updates,) = {run["training"]["updates"] for run in runs}
    (image,) = {run["env"]["options"]["image_size"] for run in runs}
    looked_at = json.loads((RESULTS / "cube_move" / "diagnosis" / "diagnosis.json").read_text())["settings"]
    return [
        grid(numbers),
        f"FOCUS + PCP and FOCUS + LCP have {updates:,} here",
        f"of FOCUS + LCP on {looked_at['sequences']} sequences of its data",
        f"at {image} × {image} the cube",
    ]


def measured() -> list[str]:
    numbers = report("cube_move")
    goals, after = diagnosis("cube_move")
    scores = {name: curve(RESULTS / "cube_move" / f"focus_{name}_seed_0.csv") for name in ("pcp", "lcp")}
    rounds = {
        name: ", ".join(f"{values[step]:.2f}" for step in (7500, 10000, 12500, 15000))
        for name, values in scores.items()
    }
    score = {agent: mean(numbers, agent, "final_score") for agent in numbers.rows}
    missed = [int((numbers.rows[f"focus_{name}"].seeds[0]["success"] == 0).sum()) for name in ("pcp", "lcp")]
    imagined, real = (
        [mean(numbers, f"focus_{name}", metric, 100) for name in ("pcp", "lcp")]
        for metric in ("imagined_distance", "final_distance")
    )
    for name in ("pcp", "lcp"):
        returns = curve(RESULTS / "cube_move" / f"focus_{name}_seed_0_imagined_return.csv")
        assert min(returns, key=lambda step: returns[step]) == pytest.approx(600, abs=100)
    frames = goals["position, frame"], goals["image, frame"]
    apart = [1000 * one["distance"] for one in frames]
    metrics = ("imagined_distance", "goal_error", "entity_error")
    expected, goal, known = (mean(numbers, "dreamer", metric, 100) for metric in metrics)
    return [
        f"within 5 cm of {mean(numbers, 'focus_pcp', 'success'):.0%} of its goals",
        f"expects to end {expected:.0f} cm from the goal, and does",
        f"of its goal is {goal:.0f} cm off, while it knows the cube to {known:.1f} cm",
        "falls for 600 updates and then rises",
        "is about that of doing nothing after 5,000 updates on scripted and random data",
        f"{scores['pcp'][5000]:.2f} for PCP and {scores['lcp'][5000]:.2f} for LCP. After the four rounds",
        f"{rounds['pcp']} for [PCP]",
        f"{rounds['lcp']} for [LCP]",
        f"more than 5 cm off for {missed[0]} of 36 goals with PCP and {missed[1]} with LCP",
        f"expect to end {imagined[0]:.1f} and {imagined[1]:.1f} cm off on average",
        f"where it is {real[0]:.1f} and {real[1]:.1f}",
        f"LCP is behind PCP by {score['focus_pcp'] - score['focus_lcp']:.2f}, "
        f"image goals by {score['focus_lcp'] - score['focus_lcp, image goals']:.2f} more",
        f"Seen frames give the position to {after['filtered']['median']:.0f} mm in the median, "
        f"and imagined ones to {after['imagined']['median']:.0f} mm after 15 steps",
        f"better in the median ({after['unmoved']['median']:.0f} mm)",
        f"({after['unmoved']['upper']:.0f} mm against {after['imagined']['upper']:.0f} mm)",
        f"{apart[0]:.1f} mm beside it on average ({apart[1]:.1f} mm for an image)",
        f"for {frames[0]['ranked_first']:.0%} of positions",
    ]


def test_page() -> None:
    sentences = [*measured(), *protocol(), *STATED]
    assert missing("cube_move", sentences) == []
    assert unchecked("cube_move", sentences) == []


ONLINE = "cube_move/online"
#: What was done: no file beside the page has these numbers.
STATED_ONLINE = [
    "at commit 45c8d50 on 2026-11-25 (Intel Xeon)",
    "rounds and updates took 91 minutes",
    "at commit edf6851 on 2026-11-26 (AMD EPYC): 83 minutes",
    "PyTorch 2.13.0 on the CPU",
]
ROUNDS = ("scripted and random data", "the first round", "the second", "the third", "the fourth")


def online() -> list[str]:
    """Rounds of acting and training in one command."""
    numbers, before = report(ONLINE), report("cube_move")
    runs = [settings(ONLINE, f"focus_{name}_seed_0") for name in ("lcp", "pcp")]
    ((updates, first),) = {(run["training"]["updates"], run["online"]["seed_updates"]) for run in runs}
    files = [RESULTS / ONLINE / f"focus_{name}_seed_0.csv" for name in ("lcp", "pcp")]
    curves = [curve(file) for file in (*files, RESULTS / "cube_move" / "focus_pcp_seed_0.csv")]
    after = [updates - (len(ROUNDS) - 1 - number) * (updates - first) // (len(ROUNDS) - 1) for number in range(5)]
    lines = [
        f"| {name} | {' | '.join(f'{one[at]:.2f}' for one in curves)} |" for name, at in zip(ROUNDS, after, strict=True)
    ]
    rows = ("focus_lcp", "focus_lcp, image goals")
    assert all(mean(numbers, row, "final_score") > mean(before, row, "final_score") for row in rows)
    was = " and ".join(f"{mean(before, row, 'final_score'):.2f}" for row in rows)
    now, then = (one.rows["focus_pcp"].seeds[0]["final_score"] for one in (numbers, before))
    assert torch.equal(numbers.goals, before.goals)
    error = float((now - then).std()) / len(now) ** 0.5
    expected, real = (mean(numbers, "focus_pcp", metric, 100) for metric in ("imagined_distance", "final_distance"))
    (steps,) = {max(curve(file.with_name(f"{file.stem}_steps.csv")).values()) for file in files}
    missed = int((numbers.rows["focus_pcp"].seeds[0]["success"] == 0).sum())
    return [
        *lines,
        f"more than 5 cm off for {missed} of {len(now)} goals",
        grid(numbers),
        f"when its scores were {was}",
        f"FOCUS + PCP has {now.mean():.2f}, and had {then.mean():.2f}",
        f"over the {len(now)} goals its standard error is {error:.2f}",
        f"expects to end {expected:.1f} cm off on average, where it is {real:.1f}",
        f"either dataset has {steps:,.0f} steps",
        f"{updates:,} updates with one thread",
    ]


def test_page_of_the_online_runs() -> None:
    sentences = [*online(), *STATED_ONLINE]
    assert missing(ONLINE, sentences) == []
    assert unchecked(ONLINE, sentences) == []


COLOURS = "cube_move/colours"
#: What was done: no file beside the page has these numbers.
STATED_COLOURS = ["at commit edf6851 on 2026-11-26", "PyTorch 2.13.0 on the CPU", "took 100 minutes"]


def colours() -> list[str]:
    """Masks by colour, beside those of the simulator."""
    numbers, true, made = report(COLOURS), report(ONLINE), settings(COLOURS, "focus_lcp_seed_0")
    assert made["env"]["options"]["labelled_frames"] == 5
    updates, first = made["training"]["updates"], made["online"]["seed_updates"]
    scores = curve(RESULTS / COLOURS / "focus_lcp_seed_0.csv")
    *rounds, last = [f"{score:.2f}" for update, score in scores.items() if update > first]
    assert max(scores) == updates
    steps = max(curve(RESULTS / COLOURS / "focus_lcp_seed_0_steps.csv").values())
    rows = ("focus_lcp", "focus_lcp, image goals")
    assert all(mean(numbers, row, "final_score") > mean(true, row, "final_score") for row in rows)
    was = " and ".join(f"{mean(true, row, 'final_score'):.2f}" for row in rows)
    return [
        grid(numbers),
        f"the scores are [{was}]",
        f"score is {scores[first]:.2f} after {first:,} updates on scripted and random data, and",
        f"{', '.join(rounds)} and {last} after the rounds",
        f"the dataset has {steps:,.0f} steps",
    ]


def test_page_of_the_run_on_colours() -> None:
    sentences = [*colours(), *STATED_COLOURS]
    assert missing(COLOURS, sentences) == []
    assert unchecked(COLOURS, sentences) == []


OFFLINE = "cube_move/offline"
#: What was done: no file beside the page has these numbers.
STATED_OFFLINE = ["At commit acea4f6 on 2026-11-26", "PyTorch 2.13.0 on the CPU", "took 122 minutes"]


def offline() -> list[str]:
    """The data of another agent."""
    numbers, made = report(OFFLINE), settings(OFFLINE, "focus_pcp_seed_0")
    steps = max(curve(RESULTS / ONLINE / "focus_lcp_seed_0_steps.csv").values())
    scores = curve(RESULTS / OFFLINE / "focus_pcp_seed_0.csv")
    updates = made["training"]["updates"]
    expected, real = (mean(numbers, "focus_pcp", metric, 100) for metric in ("imagined_distance", "final_distance"))
    assert made["training"]["updates"] == settings(ONLINE, "focus_lcp_seed_0")["training"]["updates"] == max(scores)
    return [
        grid(numbers),
        f"expects to end {expected:.1f} cm from the goal, and ends {real:.1f} cm from it",
        f"it scored {mean(report('cube_move'), 'focus_pcp', 'final_score'):.2f}]",
        f"this data is {steps:,.0f} steps in which",
        f"is {scores[2500]:.2f} after 2,500 updates, {scores[5000]:.2f} after 5,000 and",
        f"{scores[updates]:.2f} in the end",
        f"{updates:,} updates with one thread",
    ]


def test_page_of_the_offline_run() -> None:
    sentences = [*offline(), *STATED_OFFLINE]
    assert missing(OFFLINE, sentences) == []
    assert unchecked(OFFLINE, sentences) == []


def test_online_scores_of_the_readme() -> None:
    rows = ("focus_lcp", "focus_lcp, image goals", "focus_pcp")
    lcp, images, pcp = (f"{mean(report(ONLINE), row, 'final_score'):.2f}" for row in rows)
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"`focus_lcp` scores {lcp}, with images {images}, `focus_pcp` {pcp}" in text
