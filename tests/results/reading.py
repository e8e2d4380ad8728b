"""What the files beside a page say, and which numbers of the page nobody has checked."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.evaluation.report import COLUMNS, _cell

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
NOT_PROSE = re.compile(r"^```.*?^```|^\|[^\n]*$|`[^`\n]*`|(?<=\])\([^)]*\)", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?%?(?![\w])")


def page(name: str) -> str:
    """A page with each run of white space as one blank."""
    return " ".join((RESULTS / name / "README.md").read_text().split())


def report(name: str) -> Report:
    return Report.load(RESULTS / name / "results.json")


def mean(report: Report, agent: str, metric: str, scale: float = 1) -> float:
    summary = report.summary(agent, metric)
    assert summary is not None
    return scale * summary[0]


def cell(report: Report, agent: str, metric: str) -> str:
    return _cell(report.summary(agent, metric), COLUMNS[metric][1])


def grid(report: Report) -> str:
    """What a page says of an evaluation's goals."""
    goals, side = len(report.goals), math.isqrt(len(report.goals))
    return f"{goals} goals, a {side} × {side} grid over the workspace; {report.settings['episode_steps']} steps each"


def diagnosis(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Goal latents, and errors in millimetres after 15 steps."""
    numbers = json.loads((RESULTS / name / "diagnosis" / "diagnosis.json").read_text())
    after = {
        view: {kind: 1000 * values[0][14] for kind, values in curves.items()}
        for view, curves in numbers["errors"].items()
    }
    return numbers["goal_latents"], after


def curve(file: Path) -> dict[int, float]:
    with file.open() as lines:
        return {int(float(step)): float(value) for step, value in csv.reader(lines)}


def settings(name: str, run: str) -> dict[str, Any]:
    """Those that a run was made with."""
    loaded = yaml.safe_load((RESULTS / name / f"{run}.yaml").read_text())
    assert isinstance(loaded, dict)
    return loaded


def unchecked(name: str, sentences: Sequence[str]) -> list[str]:
    """The numbers in the prose of a page that are in none of the sentences: not those of tables, code and links."""
    prose = " ".join(NOT_PROSE.sub("", (RESULTS / name / "README.md").read_text()).split())
    for sentence in sorted(sentences, key=len, reverse=True):
        prose = prose.replace(" ".join(NOT_PROSE.sub("", sentence).split()), "")
    return NUMBER.findall(prose)


def missing(name: str, sentences: Sequence[str]) -> list[str]:
    """Those of the sentences that the page does not say."""
    text = page(name)
    return [sentence for sentence in sentences if sentence not in text]
