"""What evidence is made of: runs, each found by the content of its settings."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

from torchrl_ocwm.evidence.command_line import Command
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.settings import to_dict


@dataclass(frozen=True, kw_only=True)
class Run(ABC):
    """Something to be done once: its folder is named by the content of its settings.

    Commands that have been stopped, or that were run before, go on where they were when they are run again.
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def prefix(self) -> str:
        """What people call it by."""

    @property
    @abstractmethod
    def content(self) -> dict[str, Any]:
        """The settings that decide what it finds."""

    @property
    @abstractmethod
    def work(self) -> int:
        """How much there is to do: steps or updates."""

    @property
    @abstractmethod
    def pace(self) -> str:
        """What it is as fast as, of other runs."""

    @property
    def needs(self) -> tuple[Run, ...]:
        """What has to be there before."""
        return ()

    @abstractmethod
    def commands(self, root: Path, machine: Machine) -> list[Command]:
        """What does it, one after the other."""

    @abstractmethod
    def reached(self, root: Path) -> int:
        """How much of the work is done, as far as its files say."""

    def episodes(self, root: Path) -> str:  # noqa: ARG002
        """What tells the episodes of a dataset, or those that it learnt from, as far as its files say."""
        return ""

    def coverage(self, root: Path) -> dict[str, dict[str, float]]:  # noqa: ARG002
        """Of a dataset: what it shows of each object, as far as its files say."""
        return {}

    @cached_property
    def name(self) -> str:
        """Its folder in that of all runs; runs of the same name are the same.

        Settings with their default are no part of it: one that is added later, with what was the rule before as its
        default, changes no name.
        """
        text = json.dumps(to_dict(self.content, defaults=False), sort_keys=True)
        return f"{self.kind}/{self.prefix}-{sha256(text.encode()).hexdigest()[:8]}"
