"""The command ``ocwm``: one word for each recipe, then its settings.

``python -m torchrl_ocwm.console`` is the same, where the folder of installed commands is not on the path.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.signals import ended_by_signals

#: What there is to do → the module in ``torchrl_ocwm.recipes`` that does it, and what it is. To add one, add a row.
COMMANDS = {
    "collect": ("collect", "Collect a dataset."),
    "train": ("train_offline", "Train an agent on a dataset."),
    "train-online": ("train_online", "Train an agent that collects its data."),
    "draw-targets": ("draw_targets", "Copy a dataset, with its goals in its images."),
    "import": ("import_data", "Make a dataset of recordings in the formats of others."),
    "export": ("export_data", "Write a dataset in a format of others."),
    "evaluate": ("evaluate", "Score agents on a grid of goals; tables, pictures, videos."),
    "diagnose": ("diagnose", "Look into a world model: masks, positions, goal latents."),
    "reproduce": ("reproduce", "Make a table or figure of the paper, from nothing."),
    "play": ("play", "A page in the browser: click a goal, watch an agent and what it imagines."),
    "share": ("share", "Make a trained agent ready for others."),
}
#: Commands whose first word may be the value of a setting: ``ocwm play reacher/focus_lcp``.
FIRST_WORDS = {
    "evaluate": "checkpoint",
    "diagnose": "checkpoint",
    "play": "agent",
    "import": "source",
    "share": "evaluation",
}
_HELP, _COMPLETION = ("-h", "--help"), ("-sc", "--shell-completion")


def main() -> None:
    """Do what the command line says; the entry point of ``ocwm``."""
    command = sys.argv[1] if len(sys.argv) > 1 else _HELP[0]
    if command in _HELP:
        sys.stdout.write(help_text())
    elif command in _COMPLETION:
        _complete(sys.argv[2:])
    elif command in COMMANDS:
        del sys.argv[1]
        run(command)
    else:
        sys.exit(f"ocwm: there is no {command!r}; there are {', '.join(COMMANDS)} (ocwm --help)")


def run(command: str) -> None:
    """Run a recipe with the settings in ``sys.argv``.

    Raises:
        SystemExit: with one line, if the extra ``recipes`` is not installed, or at Ctrl-C while packages are loaded.
    """
    if command in FIRST_WORDS and (word := next(iter(sys.argv[1:]), "-")) and not _is_setting(word):
        quoted = word.replace("'", "\\'")
        sys.argv[1] = f"{FIRST_WORDS[command]}='{quoted}'"
    try:
        with ended_by_signals():  # it takes seconds
            recipe = import_module(f"torchrl_ocwm.recipes.{COMMANDS[command][0]}")
    except UserError as error:
        sys.exit(f"{type(error).__name__}: {error}")
    try:
        recipe.main()
    except BrokenPipeError:
        if not {*_HELP} & {*sys.argv}:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # who reads the help, like head, has seen enough


def help_text() -> str:
    """The commands, one line each.

    Examples:
        >>> print(help_text().splitlines()[3])
          collect       Collect a dataset.
    """
    lines = [f"  {command:13} {what}" for command, (_, what) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: ocwm COMMAND [NAME=VALUE ...]",
            "",
            "Commands:",
            *lines,
            "",
            "ocwm COMMAND --help shows the settings of a command with their meaning.",
            'eval "$(ocwm -sc install=bash)" completes commands and settings with Tab, in bash and zsh.',
            "",
        ]
    )


def _is_setting(word: str) -> bool:
    return word.startswith(("-", "+", "~")) or "=" in word


def _complete(arguments: list[str]) -> None:
    """Hydra's shell completion: commands are completed here, settings by the recipe of the command."""
    if not any(argument.startswith("query=") for argument in arguments):
        _hydra_alone()
        return
    _, _, typed = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    command, space, settings = typed.lstrip().partition(" ")
    if not space:
        sys.stdout.write("\n".join([*COMMANDS, "--help"]) + "\n")
    elif command in COMMANDS:
        os.environ["COMP_LINE"] = f"ocwm {settings}"
        run(command)


def _hydra_alone() -> None:
    """What is the same for all commands, and need not wait for PyTorch: each shell that starts asks for it."""
    try:
        import hydra
    except ModuleNotFoundError:
        sys.exit("ocwm: completion needs hydra, which is not installed: pip install 'torchrl-ocwm[recipes]'")
    hydra.main(version_base="1.3", config_path=None)(print)()


if __name__ == "__main__":
    main()
