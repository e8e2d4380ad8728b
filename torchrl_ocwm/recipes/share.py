"""Make a trained agent ready for others: ``ocwm share evaluation=outputs/evidence/evaluations/NAME``.

Writes its weights and a card to a folder that ``load_agent`` reads, and that can be uploaded to the Hugging Face Hub as
it is: ``hf upload owner/name FOLDER``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_ocwm.evidence import share
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.settings import Settings


@dataclass(frozen=True)
class Share(Settings):
    """Settings of the recipe.

    Args:
        evaluation: Folder of an evaluation of one agent, of reproduce or evaluate.
        output: Folder for the agent and its card.
        name: What others load it by; none: the output folder.
    """

    evaluation: str
    output: str = "outputs/shared"
    name: str | None = None


@recipe("share")
def main(config: Share) -> None:
    """Write agent and card."""
    print(share(Path(config.evaluation).absolute(), Path(config.output), name=config.name))
