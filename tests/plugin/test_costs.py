"""What it costs to add something stays low, and is as the documentation says."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_costs() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "costs.py"))
    files, lines = zip(*script["costs"]().values(), strict=True)
    assert all(one <= most for one, most in zip(files, (1, 1, 1, 3, 1), strict=True))
    assert all(one <= most for one, most in zip(lines, (8, 40, 3, 5, 70), strict=True))
    assert script["table"]() in (ROOT / "CONTRIBUTING.md").read_text()
