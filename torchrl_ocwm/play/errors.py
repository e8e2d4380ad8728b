"""What cannot be done on the page."""

from torchrl_ocwm.errors import UserError


class PlayError(UserError, ValueError):
    """Something that was asked for on the page and cannot be done; the page shows the message."""
