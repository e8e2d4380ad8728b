"""The tables of the documentation that are made from the code.

    python docs/tables.py            # write them
    python docs/tables.py --check    # only say which pages are out of date

A table stands in a page between ``<!-- begin table: WHAT -->`` and ``<!-- end -->``. WHAT is one of:

    agents                 the rows, with their parts
    parts KIND             the parts of a kind, with their settings
    settings CLASS [AT]    the settings of a class, their names after AT
    sizes FIELD            the values of all sizes: ``architecture`` or ``learning``
    options                the options of all environments
    trained                the trained agents that come with the package, by their cards
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Any, get_type_hints

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from torchrl_ocwm.agents import AGENTS, SIZES, shipped_agents  # noqa: E402
from torchrl_ocwm.envs import ENVIRONMENTS  # noqa: E402
from torchrl_ocwm.parts import Part  # noqa: E402
from torchrl_ocwm.recipes import code, is_group, values, written_out  # noqa: E402
from torchrl_ocwm.settings import Settings, field_docs, plain_text  # noqa: E402

CELLS = re.compile(r"^\| (.+) \|$", re.MULTILINE)
TABLE = re.compile(r"(<!-- begin table: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit with 1 if a table is out of date")
    check = parser.parse_args().check
    stale = [page for page in pages() if written(text := page.read_text()) != text]
    for page in stale:
        print(f"{page.relative_to(ROOT)}: {'out of date; run python docs/tables.py' if check else 'written'}")
        if not check:
            page.write_text(written(page.read_text()))
    sys.exit(1 if check and stale else 0)


def pages() -> list[Path]:
    """All pages that may have tables."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def written(text: str) -> str:
    """A page with its tables as they should be."""
    return TABLE.sub(lambda match: f"{match[1]}\n{table(match[2])}\n{match[3]}", text)


def table(what: str) -> str:
    """A table, one line for each row, and an empty line."""
    kind, *arguments = what.split()
    makers = (agents, parts, settings, sizes, options, trained)
    head, *rows = {maker.__name__: maker for maker in makers}[kind](*arguments)
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, ["---"] * len(head), *rows))


def agents() -> Iterator[Sequence[str]]:
    """A line for each behaviour of each row."""
    yield "row", "world model", "behaviour", "goal", "imagined reward", "goals in imagination"
    for name, row in AGENTS.items():
        first = [code(name), part(row.world_model)]
        for behaviour, one in row.behaviours.items():
            yield [*first, code(behaviour), part(one.goal), part(one.reward), part(one.goals)]
            first = ["", ""]


def parts(kind: str) -> Iterator[Sequence[str]]:
    """A line for each part, and one for each of its settings."""
    yield kind.replace("_", " "), "setting", "default", "values", "meaning"
    for name, one in Part.registered[kind].items():
        yield code(name), "", "", "", summary(one)
        yield from (["", *cells] for cells in rows_of(one))


def settings(name: str, at: str = "") -> Iterator[Sequence[str]]:
    """A line for each setting."""
    module, _, cls = name.rpartition(".")
    yield "setting", "default", "values", "meaning"
    yield from rows_of(getattr(import_module(module), cls), at)


def sizes(field: str) -> Iterator[Sequence[str]]:
    """A line for each setting, a column for each size."""
    yield "setting", *map(code, SIZES)
    columns = [getattr(size, field) for size in SIZES.values()]
    for one in fields(columns[0]):
        yield code(one.name), *(value_of(getattr(column, one.name)) for column in columns)


def options() -> Iterator[Sequence[str]]:
    """A line for each option, with the default of each environment."""
    yield "option", *map(code, ENVIRONMENTS), "values", "meaning"
    kinds = [environment.options for environment in ENVIRONMENTS.values()]
    for name in dict.fromkeys(one.name for kind in kinds for one in fields(kind)):
        having = [next((one for one in fields(kind) if one.name == name), None) for kind in kinds]
        kind, one = next((kind, one) for kind, one in zip(kinds, having, strict=True) if one)
        defaults = ["–" if one is None else default(one) for one in having]
        yield code(name), *defaults, values(kind, one), field_docs(kind)[name]


def trained() -> Iterator[Sequence[str]]:
    """A line for each agent that comes with the package, from the tables of its card."""
    yield "name", "updates", "goals", "final score", "goals as images", "success within 5 cm", "final distance, m"
    for name in shipped_agents():
        place = f"torchrl_ocwm/trained/{name}/README.md"
        card = (ROOT / place).read_text(encoding="utf-8")
        lines = {first: rest for first, *rest in (line.split(" | ") for line in CELLS.findall(card))}
        row, goals = name.split("/")[1], re.findall(r"^(\d+) goals", card, re.MULTILINE)
        positions, images = lines.get(row), lines.get(f"{row}, image goals")
        scores = [cells[1] if cells else "–" for cells in (positions, images)]
        _, _, _, success, distance, *_ = positions or images or []
        updates = lines["training"][0].split(" updates")[0]
        yield f"[{code(name)}](../{place})", updates, *goals, *scores, success, distance


def rows_of(kind: type[Settings], at: str = "") -> Iterator[Sequence[str]]:
    """Name, default, values and meaning of each setting of a class, but for groups of settings: they have their own."""
    hints = get_type_hints(kind)
    for one in fields(kind):  # type: ignore[arg-type]
        if not is_group(hints[one.name]):
            name = f"{at}.{one.name}" if at else one.name
            yield code(name), default(one), values(kind, one), field_docs(kind)[one.name]


def default(one: Field) -> str:
    """The default of a setting, as the command line takes it."""
    if one.default_factory is not MISSING:
        return value_of(one.default_factory())
    return "has to be given" if one.default is MISSING else value_of(one.default)


def value_of(value: Any) -> str:
    """A value, as the command line takes it."""
    if isinstance(value, Part):
        return part(value)
    if isinstance(value, dict):
        return ", ".join(map(code, value)) or "none"
    return code(written_out(value))


def part(value: Part) -> str:
    """A part's name, and those of its settings that are not the default."""
    known = value.name_and_kind()
    assert known is not None
    given = {one.name: getattr(value, one.name) for one in fields(value) if getattr(value, one.name) != one.default}
    changed = ", ".join(code(f"{name}={written_out(one)}") for name, one in given.items())
    return f"{code(known[0])} with {changed}" if changed else code(known[0])


def summary(kind: type) -> str:
    """The first paragraph of a docstring."""
    return plain_text(cleandoc(kind.__doc__ or "").split("\n\n")[0])


if __name__ == "__main__":
    main()
