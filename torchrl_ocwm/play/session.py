"""A simulation that goes on: an agent acts, and goals and objects are moved meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import interpolate
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.agents import Policy
from torchrl_ocwm.envs import Camera, PositioningEnv, SimulationDivergedError, find_environment, make_scene
from torchrl_ocwm.evaluation import imagined_rollout, normalized_score
from torchrl_ocwm.play.beliefs import decoded_masks, decoded_pixels, decoded_position
from torchrl_ocwm.play.errors import PlayError
from torchrl_ocwm.play.places import Places, Point


class View(NamedTuple):
    """What is to be seen of a step.

    Places in images are (column, row), each from 0 to 1.

    Args:
        camera: The scene, ``[S, S, 3]`` uint8.
        seen: The image that the agent got, ``[H, W, 3]`` uint8.
        imagined: What the agent imagined, when it got this goal, that it would see now, ``[H, W, 3]`` uint8; ``None``
            for an agent without a world model.
        masks: Where the world model sees each object, ``[O, H, W]`` in [0, 1]; ``None`` for one without objects.
        workspace: Corners of the workspace; where goals have a height, on the level of the goal.
        goal: The goal; ``None`` for an image of somebody else's, whose place is not known.
        believed: Where the world model believes the object to be, from all it has seen; ``None`` if it does not say.
        expected: Where it is in what was imagined; ``None`` likewise.
        distance: Of the object from the goal, metres; ``None`` where the goal's place is not known.
        score: Normalised score now; ``None`` also for a goal at the start, which has none.
        mean_score: Its mean over the steps since the goal was set.
        steps: Steps since the goal was set.
    """

    camera: np.ndarray
    seen: np.ndarray
    imagined: np.ndarray | None
    masks: np.ndarray | None
    workspace: list[Point]
    goal: Point | None
    believed: Point | None
    expected: Point | None
    distance: float | None
    score: float | None
    mean_score: float | None
    steps: int


class Session:
    """One agent in its environment, step by step.

    It belongs to the thread that makes it, as OpenGL wants it. Close it, or use it in a ``with`` block.

    Args:
        environment: Name of the environment.
        policy: An agent's policy; ``None`` for the environment's scripted one.
        options: Passed to the environment.
        seed: Seeds the episodes.
        size: Height and width of the camera's picture, pixels.

    Raises:
        PlayError: for an environment that is no :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Attributes:
        env: The environment.
        places: Where positions are in the picture.
        goal: Goal position (D,), metres; ``None`` for a goal image whose place is not known.
        steps: Steps since the goal was set.

    Examples:
        >>> with Session("reacher") as session:
        ...     session.set_goal((0.1, 0.1))
        ...     before = session.distance
        ...     for _ in range(40):
        ...         session.step()
        ...     session.distance < 0.05 < before
        True
    """

    def __init__(
        self,
        environment: str,
        policy: Policy | None = None,
        *,
        options: dict[str, Any] | None = None,
        seed: int = 0,
        size: int = 384,
    ) -> None:
        self.policy, self.seed = policy, seed
        self._imagined: TensorDictBase | None = None
        self._scores: list[float | None] = []
        self.object_index = 0 if policy is None else policy.object_index
        self.env = make_scene(find_environment(environment), **(options or {}))
        try:
            if not isinstance(self.env, PositioningEnv):
                raise PlayError(f"environment {environment!r} is no PositioningEnv; only those can be played with")
            self.places = Places(self.env)
            self._camera = Camera(self.env.model, self.env.camera_name, height=size, width=size)
            self.reset()
        except BaseException:
            self.close()
            raise

    @property
    def takes_images(self) -> bool:
        """Whether a goal can be an image."""
        return self.policy is not None and self.policy.takes_images

    @property
    def takes_positions(self) -> bool:
        """Whether a goal can be a position."""
        return self.policy is None or self.policy.takes_positions

    # What happens.

    def reset(self) -> None:
        """Start a new episode, with a goal from the workspace."""
        observation = self.env.reset(seed=self.seed)[0]
        self.seed += 1
        self._before = TensorDict({"is_init": torch.ones(1, 1, dtype=torch.bool)}, [1])
        self._begin(observation, observation["goal_position"], None if self.takes_positions else self._picture())

    def step(self) -> None:
        """Let the agent act once.

        Raises:
            PlayError: if the physics broke down; a new episode has begun then.
        """
        try:
            observation = self.env.step(self._now["action"][0].numpy())[0]
        except SimulationDivergedError as error:
            self.reset()
            raise PlayError(f"{error}; a new episode begins") from error
        self._before = self._now.exclude("action", *observation).set("is_init", torch.zeros(1, 1, dtype=torch.bool))
        self._think(observation)
        self.steps += 1
        if self._imagined is not None and self.policy is not None:
            latents = imagined_rollout(self.policy.behaviour, self._imagined, 2, seed=self.steps)["latent"]
            self._imagined = latents[:, -1]
        self._scores.append(self._score())

    def set_goal(self, position: Sequence[float] | np.ndarray, *, as_image: bool = False) -> None:
        """Give the agent another goal, from now on.

        Args:
            position: (D,) metres from the start.
            as_image: Give it as an image of the object there, to an agent that takes both. One that takes images only
                gets an image anyway.

        Raises:
            PlayError: for a goal outside the workspace, or an image for an agent that takes none.
        """
        if as_image and not self.takes_images:
            raise PlayError("this agent takes goals as positions, not as images")
        observation = self.env.set_goal(self._checked(position))
        image = self._picture() if as_image or not self.takes_positions else None
        self._begin(observation, observation["goal_position"], image)

    def set_goal_image(self, image: np.ndarray) -> None:
        """Give the agent an image as its goal, of which nobody knows the place.

        Args:
            image: ``[H, W, 3]`` uint8, of the environment's camera, in any size.

        Raises:
            PlayError: for another shape or type, or an agent that takes no images.
        """
        if not self.takes_images:
            raise PlayError("this agent takes goals as positions, not as images")
        if image.ndim != 3 or image.shape[2] != 3 or image.shape[0] != image.shape[1] or image.dtype != np.uint8:
            raise PlayError(
                "a goal image is a square picture in colour, as the camera makes them; this is "
                f"{' × '.join(map(str, image.shape))}, {image.dtype}"
            )
        pixels, size = torch.from_numpy(image).permute(2, 0, 1).unsqueeze(0), self.env.image_size
        if image.shape[0] != size:
            pixels = interpolate(pixels, (size, size), mode="bilinear", antialias=True)
        self._begin(self._seen, None, pixels)

    def move_object(self, position: Sequence[float] | np.ndarray, name: str | None = None) -> None:
        """Disturb the agent: put an object somewhere else.

        Args:
            position: (D,) metres from the start.
            name: Which object; by default the one to position.

        Raises:
            PlayError: for a place outside the workspace, an object that there is not, or if the physics broke down.
        """
        names = list(self.env.objects)
        if name is not None and name not in names:
            raise PlayError(f"there is no object {name!r} here, only {', '.join(names)}")
        index = self.object_index if name is None else names.index(name)
        try:
            observation = self.env.move_object(self._checked(position), index)
        except SimulationDivergedError as error:
            self.reset()
            raise PlayError(f"{error}; a new episode begins") from error
        self._begin(observation, self.goal, self._image)

    def move_object_at_random(self) -> None:
        """Disturb the agent: put the object to position somewhere in the workspace."""
        self.move_object(self.env.workspace.sample())

    # What is to be seen.

    @property
    def distance(self) -> float | None:
        """Of the object from the goal, metres; ``None`` where the goal's place is not known."""
        if self.goal is None:
            return None
        return float(np.linalg.norm(self.env.true_position()[self.object_index] - self.goal))

    def view(self) -> View:
        """What is to be seen now."""
        scores = [score for score in self._scores if score is not None]
        latent = None if self.policy is None else self._now["latent"]
        model = None if self.policy is None else self.policy.agent.model
        return View(
            camera=self._camera.picture(self.env.data),
            seen=self._seen["pixels"].transpose(1, 2, 0),
            imagined=decoded_pixels(model, self._imagined),
            masks=decoded_masks(model, latent),
            workspace=self.places.corners(self.env.goal_position),
            goal=None if self.goal is None else self.places.point(self.goal),
            believed=self._decoded_point(latent),
            expected=self._decoded_point(self._imagined),
            distance=self.distance,
            score=self._scores[-1],
            mean_score=sum(scores) / len(scores) if scores else None,
            steps=self.steps,
        )

    def goal_pictures(self) -> list[np.ndarray]:
        """The object at each landmark of the workspace, ``[H, W, 3]`` uint8."""
        landmarks = [np.array(landmark) for landmark in self.env.workspace.landmarks]
        seen = [self.env.goal_observation(landmark, self.object_index) for landmark in landmarks]
        return [observation["pixels"].transpose(1, 2, 0) for observation in seen]

    def close(self) -> None:
        """Free the simulator and OpenGL. Closing twice does nothing."""
        if (camera := self.__dict__.pop("_camera", None)) is not None:
            camera.close()
        self.env.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _begin(self, observation: dict[str, np.ndarray], goal: np.ndarray | None, image: Tensor | None) -> None:
        """Count, and imagine, from here on."""
        self.goal, self._image, self.steps = goal, image, 0
        self._before.pop("goal", None)
        if image is not None:
            self._before["goal", "pixels"] = image
        self._think(observation)
        if self.policy is not None:
            self._imagined = self._now["latent"].select("state", "belief", "goal", strict=False)
        self._scores = [self._score()]

    @torch.no_grad()
    def _think(self, observation: dict[str, np.ndarray]) -> None:
        """What the agent makes of an observation, after what it saw before."""
        self._seen = observation
        self._now: TensorDictBase = self._before.clone()
        if self.policy is None:
            self._now["action"] = torch.from_numpy(self.env.scripted_action()).unsqueeze(0)
            return
        self._now.update({key: torch.from_numpy(np.asarray(value)).unsqueeze(0) for key, value in observation.items()})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            self._now = self.policy(self._now)

    def _picture(self) -> Tensor:
        """The object at the goal of the environment, ``[1, 3, H, W]``."""
        goal = self.env.goal_observation(self.env.goal_position, self.object_index)
        return torch.from_numpy(goal["pixels"]).unsqueeze(0)

    def _score(self) -> float | None:
        if self.goal is None:
            return None
        position = torch.from_numpy(self.env.true_position()[self.object_index])
        score = float(normalized_score(position, torch.from_numpy(self.goal)))
        return None if np.isnan(score) else score

    def _checked(self, position: Sequence[float] | np.ndarray) -> np.ndarray:
        try:
            return self.env.workspace.check(position).numpy()
        except ValueError as error:
            raise PlayError(str(error)) from error

    def _decoded_point(self, latent: TensorDictBase | None) -> Point | None:
        position = None if self.policy is None else decoded_position(self.policy.agent.model, latent, self.object_index)
        return None if position is None else self.places.point(position)
