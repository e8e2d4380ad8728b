"""What it costs to add something, as the table in CONTRIBUTING.md: ``python docs/costs.py``.

Counted on examples: the package in ``tests/plugin``, which is outside of this one, and a number that is in this one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE, EXAMPLE = ROOT / "torchrl_ocwm", ROOT / "tests" / "plugin" / "ocwm_example"
#: Files and lines at 8937f01, before parts were dataclasses that register themselves.
BEFORE = {
    "a row": (6, 32),
    "a reward and its row": (16, 68),
    "a weight of a part": (9, 15),
    "a number of the sizes": (9, 15),
    "an environment": (3, 74),
}


def whole(name: str) -> tuple[int, int]:
    """A file of the example package. ``TORCHRL_OCWM_PLUGINS`` can name it alone, so that nothing else imports it."""
    return 1, len((EXAMPLE / name).read_text().splitlines())


def mentions(name: str, files: Iterable[Path]) -> tuple[int, int]:
    """Files and lines that mention a setting, or say what it is."""
    lines = [len(re.findall(rf"^.*\b{name}\b.*$", file.read_text(), re.MULTILINE)) for file in files]
    return sum(count > 0 for count in lines), sum(lines)


def costs() -> dict[str, tuple[int, int]]:
    """What is added → files and lines."""
    return {
        "a row": whole("rows.py"),
        "a reward and its row": whole("reward.py"),
        "a weight of a part": mentions("width", [EXAMPLE / "reward.py"]),
        "a number of the sizes": mentions("entropy_bonus", (PACKAGE / "agents").rglob("*.py")),
        "an environment": whole("dots.py"),
    }


def table() -> str:
    """The costs in Markdown."""
    rows = [
        f"| {what} | {before[0]} files, {before[1]} lines | {files} files, {lines} lines |".replace("1 files", "1 file")
        for (what, (files, lines)), before in zip(costs().items(), BEFORE.values(), strict=True)
    ]
    return "\n".join(["| to add | before | now |", "|---|---|---|", *rows])


if __name__ == "__main__":
    print(table())
