"""What the page of Reacher says is in the files beside it."""

from __future__ import annotations

import json
import math
import re

from reading import RESULTS, cell, diagnosis, mean, missing, report, settings, unchecked

RUNS = [
    f"{agent}_seed_{seed}" for agent in ("dreamer", "dreamer_pcp", "focus", "focus_pcp", "focus_lcp") for seed in (0, 1)
]
#: What was done, or what the paper says: no file beside the page has these numbers.
STATED = [
    "after 250,000 updates of a larger model the paper reports 0.27 ± 0.11 for Dreamer, 0.29 for FOCUS, 0.80 ± 0.08 "
    "for Dreamer + PCP, 0.87 ± 0.04 for FOCUS + PCP, 0.91 ± 0.02 for FOCUS + LCP, and about 10% less for LCP "
    "with images",
    "frames with the tip 2 cm further reached the same value",
    "on seed 0, from 100 sequences of its training data",
    "short runs of `focus_lcp`, 1,500 updates, at commit 61cb11f",
    "More than 100 has not been tried",
    "Until 0.2.0, goal latents",
    "the same 50,000 steps of data, 1,500 updates",
    "(AMD EPYC, a shared virtual machine, PyTorch 2.13.0 on the CPU)",
    "All runs are of release 0.1",
    "The settings have their names of release 0.1",
]


def protocol() -> list[str]:
    """How the runs were made."""
    runs = [settings("reacher", run) for run in RUNS]
    (updates,) = {run["training"]["updates"] for run in runs}
    (entity,) = {run["agent"]["lambda_object_position"] for run in runs}
    (goal,) = {run["agent"]["lambda_goal_position"] for run in runs if run["agent"]["goal"] == "none"}
    weight = settings("reacher", "focus_lcp_seed_0")["agent"]["lambda_positional"]
    before = settings("reacher/ablations", "focus_lcp_weight_1_seed_0")["agent"]["lambda_positional"]
    script = (RESULTS / "reacher" / "run.sh").read_text()
    steps = int(re.findall(r"steps=(\d+)", script)[0])
    assert f"training.updates={updates} " in script
    steps_each = report("reacher").settings["episode_steps"]
    goals = len(report("reacher").goals)
    side = math.isqrt(goals)
    return [
        f"{goals} goals, a {side} × {side} grid over what the arm can reach; {steps_each} steps each",
        f"{goals} goals. All numbers: [before]",
        f"These runs have {updates:,}",
        f"on two and over {updates:,} updates",
        f"{steps:,} steps of smooth random actions in {steps // 500} episodes, then {updates:,} updates per run",
        f"The table above, of {updates:,} updates, is of before",
        f"with {entity:.0f}, `dreamer` and `focus` that of the goal with {goal:.0f}",
        f"With a weight of {before:.0f}, the cosine",
        f"With a weight of {weight:.0f} (",
        f"default is `both` with {weight:.0f}, measured",
        f"With a weight of {before:.0f}, there is little",
    ]


def measured() -> list[str]:
    numbers, ablations = report("reacher"), report("reacher/ablations")
    goals, after = diagnosis("reacher")
    off = [mean(numbers, agent, "goal_error", 100) for agent in ("dreamer", "focus")]
    tip = [mean(numbers, agent, "entity_error", 1000) for agent in ("dreamer", "focus")]
    (off_cm,), (tip_mm,) = ({f"{value:.0f}" for value in values} for values in (off, tip))
    pcp = sorted(mean(numbers, agent, "final_distance", 1000) for agent in ("focus_pcp", "dreamer_pcp"))
    known = sorted(mean(numbers, agent, "entity_error", 1000) for agent in ("focus_pcp", "dreamer_pcp"))
    assert [mean(numbers, agent, "success") for agent in ("focus_pcp", "dreamer_pcp", "focus_lcp")] == [1, 1, 1]
    lcp = mean(numbers, "focus_lcp", "final_distance", 1000)
    before = sorted(mean(ablations, agent, "final_distance", 100) for agent in ablations.rows if "image" not in agent)
    lost = numbers.per_goal("final_score")["focus_lcp"] - numbers.per_goal("final_score")["focus_lcp, image goals"]
    radius = numbers.goals.norm(dim=-1)
    at = {r: float(lost[(100 * radius).round() == r].mean()) for r in (5, 8, 22)}
    assert abs(at[5]) < 0.005
    assert at[8] == max(float(lost[(100 * radius).round() == r].mean()) for r in (100 * radius).round().unique())
    times = [line.split()[1] for line in (RESULTS / "reacher" / "wall_time.txt").read_text().splitlines()]
    minutes = sorted(int(seconds) / 60 for seconds in times)
    frames = goals["position, frame"], goals["image, frame"]
    assert [one["median_rank"] for one in frames] == [1, 1]
    first, apart = [one["ranked_first"] for one in frames], [1000 * one["distance"] for one in frames]
    seen = after["filtered"]["median"]
    weight_1 = (RESULTS / "reacher" / "ablations" / "diagnosis_weight_1_seed_0.md").read_text()
    looked_at = json.loads((RESULTS / "reacher" / "diagnosis" / "diagnosis.json").read_text())["settings"]
    (cosine,) = re.findall(r"position, frame \| ([\d.]+)", weight_1)
    sentences = [
        f"what they decode of it is {off_cm} cm off",
        f"They know where the finger tip is to {tip_mm} mm",
        f"that of staying at the origin, 1/e ≈ {math.exp(-1):.2f}",
        f"at the true position was [{float(cosine):.2f}]",
        f"With PCP both stop {pcp[0]:.0f} to {pcp[1]:.0f} mm from their goals on average**, and within 5 cm of all",
        f"both know where it is to {known[0]:.0f} to {known[1]:.0f} mm",
        f"{lcp:.0f} mm from its goals on average, and within 5 cm of all of them",
        f"it stayed {before[0]:.0f} to {before[-1]:.0f} cm off",
        f"Image goals cost LCP {lost.mean():.2f}**",
        f"A goal costs most, {at[8]:.2f}, at 8 cm from the origin, nothing at 5 cm, and {at[22]:.2f} at 22 cm",
        f"{float(lost[radius > 0.16].sum() / lost.sum()):.0%} of the loss is beyond 16 cm",
        f"it comes first of {looked_at['frames']} frames for {first[0]:.0%} of the positions "
        f"and {first[1]:.0%} of the images, median rank 1",
        f"{apart[0]:.1f} mm from the goal for positions, {apart[1]:.0f} mm for images",
        f"it is {frames[0]['cosine']:.3f}, and the decoder has lost nothing by it: {seen:.0f} mm",
        f"After 15 imagined steps the decoded position is {after['imagined']['median']:.0f} mm off",
        f"a guess that nothing moves is {after['unmoved']['median']:.0f} mm off",
        f"{minutes[0]:.0f} to {minutes[-1]:.0f} minutes",
    ]
    rows = {
        "| cosine | 1 | {} | 1 |": (ablations, "focus_lcp (lambda_positional=1.0, reward=latent_similarity)"),
        "| distance of the directions | 1 | {} | 2 |": (ablations, "focus_lcp (lambda_positional=1.0)"),
        "| distance of the directions | 100 | {} | 2 |": (numbers, "focus_lcp"),
    }
    for row, (source, agent) in rows.items():
        for kind, suffix in (("positions", ""), ("images", ", image goals")):
            cells = [cell(source, agent + suffix, metric) for metric in ("final_score", "success", "final_distance")]
            sentences.append(f"{row.format(kind)} {' | '.join(cells)} |")
    return sentences


def goals_of_one_length() -> list[str]:
    """The table's rows, and what is said of them."""
    sentences = []
    scores = {}
    for when, commit in (("before", "8937f01"), ("after", "2978348")):
        numbers = json.loads((RESULTS / "reacher" / "goal_length" / f"{when}.json").read_text())["agents"]
        for row, goals in (("focus_lcp", "positions"), ("focus_lcp, image goals", "images")):
            means = {name: metric["mean"] for name, metric in numbers[row]["metrics"].items() if metric is not None}
            scores[when, goals] = round(means["final_score"], 2)
            cells = (f"{means['final_score']:.2f}", f"{means['success']:.2f}", f"{means['final_distance']:.3f}")
            label = f"{commit}, {when}" if goals == "positions" else ""
            sentences.append(f"| {label} | {goals} | {' | '.join(cells)} |".replace("|  |", "| |"))
    lost = {when: scores[when, "positions"] - scores[when, "images"] for when in ("before", "after")}
    return [
        *sentences,
        f"Images lost {lost['before']:.2f} to positions before, and lose {lost['after']:.2f} after",
        f"positions have {scores['before', 'positions'] - scores['after', 'positions']:.2f} less",
    ]


def test_page() -> None:
    sentences = [*measured(), *protocol(), *goals_of_one_length(), *STATED]
    assert missing("reacher", sentences) == []
    assert unchecked("reacher", sentences) == []
