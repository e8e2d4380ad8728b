"""A table or figure of the paper, from nothing: ``ocwm reproduce figure=table env=reacher seeds=3``.

Says how long it will take here, collects, trains and evaluates what is not there yet, and writes a page. Can be stopped
at any moment (Ctrl-C, SIGTERM, killed) and run again: it goes on where it was. Figures share the runs that they have in
common. ``dry_run=true`` only says what there is to do.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_ocwm.evidence import (
    LAUNCHERS,
    Evaluated,
    Evidence,
    Machine,
    Run,
    forecast,
    in_order,
    include,
    results,
    table,
    work_off,
    write_page,
)
from torchrl_ocwm.files import only_writer
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.signals import ended_by_signals


@dataclass(frozen=True, kw_only=True)
class Reproduce(Evidence, Machine):
    """Settings of the recipe.

    Args:
        include: Folders of pages of this command, of this machine or another. Their runs count as done.
        dry_run: Only say what there is to do, and how long it takes; pages to include are taken over all the same.
        output: Folder of all runs and figures. Give all figures the same.
    """

    include: tuple[str, ...] = ()
    dry_run: bool = False
    output: str = "outputs/evidence"


@recipe("reproduce")
@ended_by_signals()
def main(config: Reproduce) -> None:
    """Say what is missing, do it, and write the page."""
    wanted = results(config)
    runs = in_order(one.evaluated for one in wanted)
    root = Path(config.output).absolute()
    for folder in config.include:
        print(f"{folder}: {len(include(folder, wanted, root))} evaluations taken over")
    launcher = LAUNCHERS[config.launcher](config)
    rows = {run.name: one.row.name for one in wanted for run in (one.evaluated, one.evaluated.trained)}
    print(table(forecast(runs, root, config), launcher.slots, rows), flush=True)
    if config.dry_run:
        return
    root.mkdir(parents=True, exist_ok=True)

    def on_done(run: Run) -> None:
        print(f"done: {run.name}", flush=True)
        if isinstance(run, Evaluated):
            write_page(config, wanted, root)

    with only_writer(root):
        work_off(runs, root, config, launcher, on_done=on_done)
        print(f"page: {write_page(config, wanted, root)}")
