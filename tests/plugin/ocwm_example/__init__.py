"""A package as somebody else would write it: parts, a row and an environment, registered as they are imported."""

from ocwm_example import dots, goals, models, novelty, reward  # noqa: F401
