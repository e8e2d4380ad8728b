"""A package as somebody else would write it: parts, rows and an environment, registered as they are imported."""

from ocwm_example import dots, goals, models, novelty, reward, rows  # noqa: F401
