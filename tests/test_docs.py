"""The Python in the documentation runs, page by page, from top to bottom, and its tables are those of the code."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType

import pytest

import torchrl_ocwm
from torchrl_ocwm.agents import AGENTS, AgentConfig, Size, shipped_agents
from torchrl_ocwm.agents.checkpoint import Description
from torchrl_ocwm.envs import ENVIRONMENTS, ActionRange, Task, Workspace
from torchrl_ocwm.envs.options import EnvOptions
from torchrl_ocwm.envs.registry import EnvChoice, RecordedEnv
from torchrl_ocwm.parts import Part
from torchrl_ocwm.settings import Settings

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLES = ROOT / "docs" / "tables.py"


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


@pytest.fixture
def registries() -> Iterator[None]:
    """What a page registers is gone after it."""
    every = [AGENTS, ENVIRONMENTS, *Part.registered.values()]
    before = [dict(one) for one in every]
    yield
    for registry, rows in zip(every, before, strict=True):
        registry.clear()
        registry.update(rows)


@pytest.mark.usefixtures("registries")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
def test_python_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    module = ModuleType("docs_page")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    names = set(vars(module))
    for number, block in enumerate(blocks(page)):
        exec(compile(block, f"{page.name}, block {number}", "exec", dont_inherit=True), module.__dict__)
    assert set(vars(module)) > names


def test_the_papers_parts_are_where_the_page_says() -> None:
    names = re.findall(r"`torchrl_ocwm\.(\w+)\.(\w+)`", (ROOT / "docs" / "paper.md").read_text())
    assert len(names) > 20
    for room, name in names:
        assert name in import_module(f"torchrl_ocwm.{room}").__all__, f"torchrl_ocwm.{room} has no {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    missing = []
    for file, _, anchor in re.findall(r"\]\((?!\w+://)([^)#]*)(#([^)]*))?\)", page.read_text()):
        target = page.parent / file if file else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            missing.append(f"{file}#{anchor}")
    assert not missing


def anchors(page: Path) -> set[str]:
    """The headings of a page, as links name them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_tables_are_those_of_the_code() -> None:
    done = subprocess.run(
        [sys.executable, str(TABLES), "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_trained_agents_are_listed_by_their_cards() -> None:
    page = (ROOT / "docs" / "getting_started.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| \[`(\w+/\w+)`\]", page, re.MULTILINE) == list(shipped_agents())
    assert "/reacher/focus_lcp/README.md) | 1,500 | 100 | 0.87 | 0.85 | 0.99 | 0.019 |" in page
    assert "/shelf_place/focus_pcp/README.md) | 15,000 | 100 | 0.76 | – | 0.60 | 0.083 |" in page


@pytest.mark.parametrize("name", shipped_agents())
def test_the_card_of_a_trained_agent_says_where_it_is_from(name: str) -> None:
    card = (ROOT / "torchrl_ocwm" / "trained" / name / "README.md").read_text(encoding="utf-8")
    said = dict(re.findall(r"^\| (\w+) \| ([^|]+) \|$", card, re.MULTILINE))
    assert {"agent", "environment", "data", "training", "commit"} <= said.keys()
    assert "seed" in said["training"]
    assert re.match(r"[0-9a-f]{8}\b", said["commit"])


def test_every_settings_class_has_a_table() -> None:
    tables = set(re.findall(r"<!-- begin table: (.+?) -->", "".join(page.read_text() for page in PAGES)))
    named = {word.rpartition(".")[2] for table in tables if table.startswith("settings ") for word in table.split()[1:]}
    parts = {table.split()[1] for table in tables if table.startswith("parts ")}
    assert {"agents", "options", "sizes architecture", "sizes learning", "trained"} <= tables
    assert parts == set(Part.registered)
    # They hold others, are shown otherwise, or are what datasets and checkpoints keep.
    others = {ActionRange, AgentConfig, Description, EnvChoice, RecordedEnv, Size, Task, Workspace}
    lacking = [
        kind.__name__
        for kind in subclasses(Settings)
        if kind.__module__.startswith("torchrl_ocwm.")
        and not issubclass(kind, (Part, EnvOptions))
        and kind not in others
        and not {kind.__name__, *recipes_of(kind)} & named
    ]
    assert not lacking


def subclasses(kind: type) -> Iterator[type]:
    """All classes below a class, in all modules of the library."""
    for module in walk_packages(torchrl_ocwm.__path__, "torchrl_ocwm."):
        import_module(module.name)
    return below(kind)


def below(kind: type) -> Iterator[type]:
    for one in kind.__subclasses__():
        yield one
        yield from below(one)


def recipes_of(kind: type) -> set[str]:
    """The settings classes of recipes below a class, which have its settings too."""
    text = "".join(script.read_text() for script in (ROOT / "torchrl_ocwm" / "recipes").glob("*.py"))
    return set(re.findall(rf"class (\w+)\([^)]*\b{kind.__name__}\b[^)]*\)", text))
