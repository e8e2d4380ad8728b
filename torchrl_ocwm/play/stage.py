"""The session that a page shows, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from torchrl_ocwm.play.errors import PlayError
from torchrl_ocwm.play.players import Player
from torchrl_ocwm.play.session import Session

T = TypeVar("T")


class Stage:
    """A session that can be asked from any thread, and exchanged for another.

    A web server answers in many threads; a simulation belongs to one, as OpenGL wants it.

    Args:
        players: Who can act; the first begins.
        seed: Seeds the episodes.

    Close it, or use it in a ``with`` block.

    Attributes:
        player: Who acts.
        behaviour: Which behaviour; ``None`` for that which acts unless another is chosen.
    """

    def __init__(self, players: Sequence[Player], *, seed: int = 0) -> None:
        self.players = {player.name: player for player in players}
        self.seed = seed
        self._thread = ThreadPoolExecutor(1, "play")
        self._session: Session | None = None
        try:
            self.choose(players[0].name)
        except BaseException:
            self.close()
            raise

    def choose(self, name: str, behaviour: str | None = None) -> None:
        """Let somebody else act; if that fails, all stays as it was.

        Args:
            name: Of a player.
            behaviour: Which of its behaviours; ``None`` for that which acts unless another is chosen.

        Raises:
            UserError: for an unknown player, or one that cannot act here.
        """
        if name not in self.players:
            raise PlayError(f"there is no agent {name!r} here; start the page with it, or choose another one")
        self.player = self._thread.submit(self._exchange, self.players[name], behaviour).result()
        self.behaviour = behaviour or self.player.acting

    def do(self, action: Callable[[Session], T]) -> T:
        """Do something with the session, after what is being done."""
        return self._thread.submit(lambda: action(self._open())).result()

    def close(self) -> None:
        """End the simulation. Closing twice does nothing."""
        if self._session is not None:
            self._thread.submit(self._session.close).result()
            self._session = None
        self._thread.shutdown()

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self) -> Session:
        assert self._session is not None
        return self._session

    def _exchange(self, player: Player, behaviour: str | None) -> Player:
        before, self._session = self._session, player.session(behaviour, seed=self.seed)
        if before is not None:
            before.close()
        return player
