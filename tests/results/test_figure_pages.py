"""The pages of ``ocwm reproduce`` that are kept can be taken over: they have the records of all runs that they list."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml

from torchrl_ocwm.evidence import Evidence, in_order, results
from torchrl_ocwm.evidence.earlier import RUNS
from torchrl_ocwm.evidence.estimate import in_words
from torchrl_ocwm.settings import from_dict

PAGES = sorted((Path(__file__).parents[2] / "docs" / "results" / "figures").glob("*/README.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_records_are_those_of_the_page(page: Path) -> None:
    records = json.loads((page.parent / RUNS).read_text(encoding="utf-8"))
    text = page.read_text(encoding="utf-8")
    listed = re.findall(
        r"^\| ((?:datasets|trainings|evaluations)/\S+) \| .* \| ([0-9a-f]{8}\+?) \| (.+) \|$", text, re.MULTILINE
    )
    assert len(listed) >= 3  # a dataset, a training, an evaluation
    assert [name for name, _, _ in listed] == list(records)
    for name, commit, wall in listed:
        record = records[name]
        assert (record["done"], record["commit"], in_words(record["seconds"])) == (True, commit, wall)
        assert record["machine"] in text
    evaluated = set()
    for file in page.parent.glob("*/results.json"):
        rows = json.loads(file.read_text(encoding="utf-8"))["agents"].values()
        evaluated |= {run for row in rows for run in row["runs"] if run.startswith("evaluations/")}
    assert evaluated == {name for name in records if name.startswith("evaluations/")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_runs_are_those_of_the_command_today(page: Path) -> None:
    """Their names are made of all settings that are no default: none of these has changed since.

    A page says how many of them are still to be done.
    """
    text = page.read_text(encoding="utf-8")
    (command,) = re.findall(r"^ocwm reproduce (.+)$", text, re.MULTILINE)
    given = {name: yaml.safe_load(value) for name, value in (setting.split("=") for setting in shlex.split(command))}
    wanted = from_dict(Evidence, given)
    runs = in_order(one.evaluated for one in results(wanted))
    missing = {run.name for run in runs} ^ set(json.loads((page.parent / RUNS).read_text(encoding="utf-8")))
    said = re.findall(r"^(\d+) of (\d+) runs are not done yet", text, re.MULTILINE)
    assert said == ([(str(len(missing)), str(len(runs)))] if missing else [])
    assert missing <= {run.name for run in runs}
