"""A page to look and click: an agent at work, goals and objects that are moved with the mouse.

Needs the extra ``play``. The page itself is in ``torchrl_ocwm.play.page``, which alone needs Gradio.
"""

from torchrl_ocwm.play.errors import PlayError
from torchrl_ocwm.play.places import Places
from torchrl_ocwm.play.players import Player, find_players
from torchrl_ocwm.play.session import Session, View
from torchrl_ocwm.play.stage import Stage

__all__ = ["Places", "PlayError", "Player", "Session", "Stage", "View", "find_players"]
