"""Recipes: settings from the command line, with Hydra. Needs the extra ``recipes``."""

from torchrl_ocwm.recipes.config import recipe

__all__ = ["recipe"]
