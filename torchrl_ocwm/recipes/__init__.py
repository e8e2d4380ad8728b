"""Recipes: settings from the command line, with Hydra. Needs the extra ``recipes``."""

from torchrl_ocwm.recipes.config import keep_settings, recipe, run_folder
from torchrl_ocwm.recipes.help import code, is_group, values, written_out

__all__ = ["code", "is_group", "keep_settings", "recipe", "run_folder", "values", "written_out"]
