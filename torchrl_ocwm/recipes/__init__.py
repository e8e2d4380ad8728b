"""Recipes: settings from the command line, with Hydra. Needs the extra ``recipes``."""

from torchrl_ocwm.recipes.config import keep_settings, recipe, run_folder

__all__ = ["keep_settings", "recipe", "run_folder"]
