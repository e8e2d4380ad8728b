"""A page to look and click: an agent at work, goals and objects that are moved with the mouse.

Needs the extra ``play``; only the page itself needs Gradio, which is imported when the page is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchrl_ocwm.lazy import lazily
from torchrl_ocwm.play.errors import PlayError
from torchrl_ocwm.play.places import Places
from torchrl_ocwm.play.players import Player, find_players
from torchrl_ocwm.play.session import Session, View
from torchrl_ocwm.play.stage import Stage

if TYPE_CHECKING:
    from torchrl_ocwm.play.page import Page

__all__ = ["Page", "Places", "PlayError", "Player", "Session", "Stage", "View", "find_players"]

__getattr__ = lazily(__name__, {"Page": "page"})
