"""A package as somebody else would write it: parts, rows and environments, registered as they are imported."""

from ocwm_example import dots, goals, models, novelty, reward, rows, waves  # noqa: F401
from torchrl_ocwm.envs import register_environment

register_environment("fetch_pick_place", "ocwm_example.fetch:FetchPickPlace", modules=("mujoco", "gymnasium_robotics"))
