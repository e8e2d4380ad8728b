"""What is known of a run: whether it is done, how long it took, and where."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evidence.command_line import Command
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.settings import flat, to_dict

RECORD, LOG = "run.json", "log.txt"


class RecordError(UserError, ValueError):
    """The record of a run cannot be read, or is of a run with other settings."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """What is known of a run, kept in its folder.

    Args:
        content: All settings that decide what it finds, those with their defaults too.
        pace: What it is as fast as.
        work: How much there was to do.
        seconds: Wall time, over all stops.
        done: Whether it is done.
        commands: What did it, paths as seen from the folder of all runs.
        commit: Of the code that did it last.
        machine: That did it last.
        episodes: Of a dataset and of a training: what tells its episodes from others, collected by the same settings.
        coverage: Of a dataset: object → how often it moves, and how much of the workspace it visits
            (:class:`~torchrl_ocwm.data.Coverage`).
    """

    content: dict[str, Any]
    pace: str
    work: int
    seconds: float = 0.0
    done: bool = False
    commands: tuple[Command, ...] = ()
    commit: str = ""
    machine: str = ""
    episodes: str = ""
    coverage: dict[str, dict[str, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Run, root: Path) -> Record:
        """That in the folder of a run, or a new one.

        Raises:
            RecordError: if the one that is there cannot be read, or another setting has changed since: a default.
        """
        new = cls(content=to_dict(run.content), pace=run.pace, work=run.work)
        file = root / run.name / RECORD
        if not file.exists():
            return new
        there = cls.read(file)
        before, now = (flat(json.loads(json.dumps(one.content))) for one in (there, new))
        for name in before.keys() & now.keys():
            if before[name] != now[name]:
                raise RecordError(
                    f"{file.parent}: was made with {name}={before[name]}, whose default is {now[name]} now; move the "
                    "folder away to run it again, or give another output folder"
                )
        return replace(there, pace=run.pace)

    @classmethod
    def read(cls, file: Path) -> Record:
        """A record from its file.

        Raises:
            RecordError: if it is none.
        """
        try:
            return cls(**json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as error:
            raise RecordError(f"{file}: not the record of a run ({error}); move the folder away") from error

    def write(self, folder: Path) -> None:
        """Keep it in the folder of its run.

        Raises:
            OutputError: if it cannot be written.
        """
        with writing(folder / RECORD) as file:
            file.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")
