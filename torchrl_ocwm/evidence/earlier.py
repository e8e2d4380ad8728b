"""Runs that a figure's page of before knows, from this machine or another: they need not be done again."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.report import Report
from torchrl_ocwm.evidence.plan import Result
from torchrl_ocwm.evidence.queue import in_order
from torchrl_ocwm.evidence.records import RECORD, Record, RecordError

#: In the folder of a page: the records of its runs, and for each environment the scores while they learnt.
RUNS, CURVES = "runs.json", "curves.csv"
#: As ``ocwm evaluate`` names rows.
IMAGE_GOALS, RANDOM = ", image goals", "random"
#: What curves show, as TorchRL's CSV logger names it.
METRIC = "evaluation/final_score"


def save_records(folder: Path, records: Mapping[str, Record]) -> None:
    """Write ``runs.json``, with which :func:`include` needs nothing else of the runs.

    Args:
        folder: Of the page.
        records: Name → record, of runs that are done.

    Raises:
        OutputError: if it cannot be written.
    """
    text = json.dumps({name: asdict(record) for name, record in records.items()}) + "\n"
    with writing(folder / RUNS) as file:
        file.write_text(text, encoding="utf-8")


def include(folder: str | Path, wanted: Sequence[Result], root: Path) -> list[str]:
    """Take over the runs of a page, wherever they were done: their records, scores and curves.

    Datasets and checkpoints are not on a page. Where a run that is still to be done needs one, it is made anew.

    Args:
        folder: Of the page.
        wanted: What is asked for; the rest of the page is left out.
        root: Folder of all runs. What is there stays as it is.

    Returns:
        The evaluations that were taken over.

    Raises:
        RecordError: if there is no page of :func:`~torchrl_ocwm.evidence.write_page`, or it has lost scores.
        ReportError: if its results cannot be read.
        OutputError: if the folder of all runs cannot be written.
    """
    folder = Path(folder)
    records, taken = _records(folder / RUNS), []
    for one in wanted:
        name, results = one.evaluated.name, folder / one.env / "results.json"
        if name not in records or (root / name / RECORD).exists():
            continue
        _scores(results, one).save(root / name)
        _curve(folder / one.env / CURVES, Path(one.evaluated.trained.name).name, root / one.evaluated.trained.name)
        for run in in_order([one.evaluated]):  # the evaluation's own comes last: all is there then
            if run.name in records and not (root / run.name / RECORD).exists():
                records[run.name].write(root / run.name)
        taken.append(name)
    return taken


def _records(file: Path) -> dict[str, Record]:
    if not file.exists():
        raise RecordError(f"{file}: not there; include names the folder of a page that `ocwm reproduce` has written")
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        return {name: Record(**value) for name, value in values.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RecordError(f"{file}: not the records of a page's runs ({error!r})") from error


def _scores(file: Path, one: Result) -> Report:
    """The report of one evaluation, with the rows that it had."""
    report, seed, name = Report.load(file), one.evaluated.trained.seed, one.evaluated.name
    found = Report(report.goals, {**report.settings, "seed": seed})
    for row in report.rows:
        for run, metrics in zip(report.rows[row].runs, report.rows[row].seeds, strict=True):
            if run == name:
                kind = IMAGE_GOALS if row.endswith(IMAGE_GOALS) else ""
                found.add(one.evaluated.trained.agent + kind, metrics, source=name)
            elif row == RANDOM and run == random_run(seed) and one.evaluated.random:
                found.add(RANDOM, metrics, source="smooth actions")
    if not found.rows:
        raise RecordError(f"{file}: has no scores of {name}, whose record is beside it")
    return found


def random_run(seed: int) -> str:
    """What tells random actions of one seed from those of another."""
    return f"seed {seed}"


def _curve(file: Path, run: str, folder: Path) -> None:
    """Scores of a training, where its log would have them."""
    if not file.exists():
        return
    with file.open(newline="", encoding="utf-8") as lines:
        scores = [f"{line['updates']},{line['final_score']}\n" for line in csv.DictReader(lines) if line["run"] == run]
    if scores:
        with writing(folder / "log" / "scalars" / f"{METRIC}.csv") as new:
            new.write_text("".join(scores), encoding="utf-8")
