"""The part that all positioning environments share: frames, masks, positions, goals and rewards."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch

from torchrl_ocwm.envs.camera import Camera, Frame
from torchrl_ocwm.envs.colour_masks import ColourMasks
from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.physics import check_physics
from torchrl_ocwm.envs.positions import masks_to_positions, pixels_to_world
from torchrl_ocwm.envs.task import SUCCESS_DISTANCE
from torchrl_ocwm.envs.virtual_target import draw_target
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.images import ImageSize, image_shape

with needs("an environment", "dm-control"):
    import gymnasium
    import mujoco
    from gymnasium import spaces

Observation = dict[str, np.ndarray]
_Seen = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # pixels, masks, positions, which objects are visible


class NoScriptedPolicyError(UserError, NotImplementedError):
    """The environment has no scripted policy."""


class PositioningEnv(gymnasium.Env[Observation, np.ndarray]):
    """Bring an entity to a goal position, seen by one fixed camera.

    Observations follow the data contract (docs/data.md): ``pixels`` (3, H, W) uint8, ``masks`` (O, H, W) bool,
    ``proprio`` (P,) float32, ``object_position`` (O, D) float32 metres from the start position, estimated from the
    masks, ``object_visible`` (O,) bool, and ``goal_position`` (D,) float32 metres. A hidden object keeps the position
    where it was last seen. With ``privileged`` there is also ``object_position_true`` (O, D), the simulator's own
    value, for tests and evaluation.

    The reward is −‖p − p_g‖₂ in metres (paper, equation 1) of the first object; ``info["success"]`` says whether it is
    within 5 cm. An agent may be about another one, with rewards of its own (:class:`~torchrl_ocwm.data.RelabelGoals`).
    Episodes are truncated after ``horizon`` steps and never terminate. The start of an episode depends on
    nothing but the seed given at its reset.

    A suite adds an environment by filling in the class attributes and the six abstract methods.

    Args:
        image_size: Height and width of the images, pixels.
        horizon: Steps per episode.
        action_repeat: Simulator control steps per step.
        mask_scale: How many times finer than the images the segmentation is that positions are read from, in height and
            width. ``masks`` are samples of it, as large as the images.
        virtual_target: Diameter in pixels of a disc drawn at the goal, 0 for none (paper, "Size matters!").
        labelled_frames: The simulator labels so many frames, and from then on objects are found by their colours
            (:class:`~torchrl_ocwm.envs.ColourMasks`), as with a real camera; 0 for the simulator's masks at every step.
        camera_options: Passed to :class:`~torchrl_ocwm.envs.Camera`: shadows, reflections, multisampling, max_geoms.
        privileged: Add ``object_position_true`` to the observations.
        render_mode: ``"rgb_array"`` makes :meth:`render` return the camera's picture (H, W, 3). For ``"human"``,
            :func:`gymnasium.make` shows it in a window.
        render_size: Height and width of that picture, pixels; one number for both. A wider one shows more at its sides.
            ``None``: the image that the agent sees.

    Attributes:
        blind: While it is set nothing is rendered, which saves most of the time of a step: images are black, and all
            objects hidden. For policies that look at nothing.

    Raises:
        ValueError: for a horizon, action repeat, image size or mask scale below one, a goal outside the workspace, or
            an action that is not finite or has another shape.
        SimulationDivergedError: if MuJoCo warns about its state, contacts or constraints, or throws a body far away.
        RuntimeError: if the environment is closed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    workspace: ClassVar[Workspace]
    #: World position that all positions are relative to, metres.
    start: ClassVar[tuple[float, float, float]]
    #: World axes that positions have.
    axes: ClassVar[tuple[int, ...]]
    camera_name: ClassVar[str]
    #: Geoms of each object, by name; the first object is the one to position.
    objects: dict[str, tuple[str, ...]]
    #: Plane (n, d) that the objects move on; ``None``: read the depth.
    plane: ClassVar[tuple[float, float, float, float] | None] = None
    #: How far the middle of an object lies behind its visible surface, metres along the optical axis.
    depth_offset: ClassVar[float] = 0.0
    blind: bool = False
    _colour_masks: ColourMasks | None = None
    _large_camera: Camera | None
    _made_with: partial[PositioningEnv]

    def __init__(
        self,
        *,
        image_size: int = 64,
        horizon: int = 500,
        action_repeat: int = 2,
        mask_scale: int = 1,
        virtual_target: int = 0,
        labelled_frames: int = 0,
        camera_options: dict[str, Any] | None = None,
        privileged: bool = False,
        render_mode: str | None = None,
        render_size: ImageSize | None = None,
    ) -> None:
        counts = {
            "image_size": image_size,
            "horizon": horizon,
            "action_repeat": action_repeat,
            "mask_scale": mask_scale,
            **({} if render_size is None else {"render_size": render_size}),
        }
        for name, value in counts.items():
            if min(image_shape(value)) < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        for name, value in {"virtual_target": virtual_target, "labelled_frames": labelled_frames}.items():
            if value < 0:
                raise ValueError(f"{name} must be 0 or more, got {value}")
        self.image_size, self.horizon, self.action_repeat = image_size, horizon, action_repeat
        self.mask_scale, self.virtual_target, self.render_mode = mask_scale, virtual_target, render_mode
        self.privileged, self.render_size, self._large_camera = privileged, render_size, None
        self.model, self.data = self._load()
        size: dict[str, Any] = {"height": image_size, "width": image_size, "mask_scale": mask_scale}
        self.camera = Camera(self.model, self.camera_name, **size, **(camera_options or {}))
        self._start, self._axes = np.array(self.start), list(self.axes)
        self._geom_ids = [[self.model.geom(name).id for name in names] for names in self.objects.values()]
        self._scratch: mujoco.MjData | None = None
        self._goal = np.zeros(self.workspace.dim, np.float32)
        self._last_seen = np.zeros((len(self.objects), self.workspace.dim), np.float32)
        self._steps = 0
        mujoco.mj_forward(self.model, self.data)
        self._plane = None if self.plane is None else torch.tensor(self.plane)
        self._intrinsics = torch.from_numpy(self.camera.intrinsics)
        self._mask_intrinsics = self._intrinsics * torch.tensor([[mask_scale], [mask_scale], [1.0]])
        self.observation_space = self._observation_space()  # type: ignore[assignment]
        self.action_space = spaces.Box(-1.0, 1.0, self._action_shape(), np.float32)
        self._colour_masks = self._learn_colours(labelled_frames) if labelled_frames else None

    def __new__(cls, *arguments: Any, **options: Any) -> PositioningEnv:
        """Keep what it is made with, to make it again where it is unpickled."""
        env = super().__new__(cls)
        env._made_with = partial(cls, *arguments, **options)
        return env

    def __reduce__(self) -> tuple[Any, ...]:
        """A simulator is not pickled but made anew, and has to be reset; its random numbers go on."""
        kept = ("spec", "_np_random", "_np_random_seed")
        return self._made_with, (), {name: self.__dict__[name] for name in kept if name in self.__dict__}

    # What a suite fills in.

    @abstractmethod
    def _load(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Load the simulator; return its MuJoCo model and data."""

    @abstractmethod
    def _reset_simulator(self) -> None:
        """Draw a start state from ``self.np_random`` into ``self.data``, which is as new, and bring it up to date."""

    @abstractmethod
    def _step_simulator(self, action: np.ndarray) -> None:
        """Advance one control step and bring ``self.data`` up to date."""

    @abstractmethod
    def _proprio(self, data: mujoco.MjData) -> np.ndarray:
        """Joint positions and velocities, (P,)."""

    @abstractmethod
    def _true_position(self, data: mujoco.MjData) -> np.ndarray:
        """World positions of the objects, (O, 3), metres."""

    @abstractmethod
    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:
        """Put an object of ``data`` at a position (D,), metres from the start, or as near as can be."""

    def _close_simulator(self) -> None:
        """Let go of whatever else holds the model and its data, so that their memory is free at once."""

    def _action_shape(self) -> tuple[int, ...]:
        return (self.model.nu,)

    def scripted_action(
        self, goal_position: np.ndarray | None = None, error: np.ndarray | Sequence[float] = (0.0, 0.0, 0.0)
    ) -> np.ndarray:
        """The action (A,) of a hand-written policy that brings the first object to a goal, from the true state.

        Args:
            goal_position: (D,) metres; the goal of the episode by default.
            error: How far from the object it is believed to be, (3,) metres in the axes of the world. A hand that
                closes there on nothing goes to the goal without the object. Nothing to a robot that does not grasp.

        Raises:
            ValueError: for a goal outside the workspace.
            NoScriptedPolicyError: if the environment has no such policy.
        """
        goal = self._goal if goal_position is None else self._check_goal(goal_position)
        return self._scripted_action(goal, np.asarray(error)).clip(-1, 1).astype(np.float32)

    def _scripted_action(self, goal: np.ndarray, error: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """What :meth:`scripted_action` does, without bounds; an environment may go without."""
        raise NoScriptedPolicyError(f"{type(self).__name__} has no scripted policy; collect with policy=random")

    # Gymnasium's interface.

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start an episode.

        Args:
            seed: Seeds the environment's random numbers.
            options: ``{"goal_position": (D,)}`` gives the goal in metres; otherwise it is uniform in the workspace.
        """
        self._check_open()
        super().reset(seed=seed)
        options = options or {}
        unknown = set(options) - {"goal_position"}
        if unknown:
            raise ValueError(f"unknown reset options {sorted(unknown)}; the only one is 'goal_position'")
        low, high = np.array(self.workspace.low), np.array(self.workspace.high)
        goal = self.np_random.uniform(low, high)  # drawn also when given, so that a goal does not move the start
        if options.get("goal_position") is not None:
            goal = self._check_goal(options["goal_position"])
        self._goal = goal.astype(np.float32)
        mujoco.mj_resetData(self.model, self.data)
        self._reset_simulator()
        self._steps = 0
        self._last_seen = np.zeros_like(self._last_seen)
        observation = self._observe(self.data)
        self._last_seen = observation["object_position"]
        return observation, {"success": self._distance(observation) <= SUCCESS_DISTANCE}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """Apply an action in [−1, 1] for ``action_repeat`` control steps; values beyond are clipped."""
        self._check_open()
        action = np.asarray(action, np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"an action has shape {self.action_space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"an action must be finite, got {action.tolist()}")
        for _ in range(self.action_repeat):
            self._step_simulator(action.clip(-1, 1))
        self._steps += 1
        observation = self._observe(self.data)
        self._last_seen = observation["object_position"]
        distance = self._distance(observation)
        success = {"success": distance <= SUCCESS_DISTANCE}
        return observation, -distance, False, self._steps >= self.horizon, success  # Eq. 1

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The camera's picture (H, W, 3) uint8, with ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            return None
        self._check_open()
        if self.render_size is None:
            return np.ascontiguousarray(self._observe(self.data)["pixels"].transpose(1, 2, 0))
        if self._large_camera is None:
            height, width = image_shape(self.render_size)
            self._large_camera = Camera(self.model, self.camera_name, height=height, width=width, multisampling=4)
        return self._large_camera.picture(self.data)

    def close(self) -> None:
        """Free the simulator and the OpenGL context. Closing twice does nothing."""
        if "camera" in self.__dict__:
            self.camera.close()
            if self._large_camera is not None:
                self._large_camera.close()
        # Wrappers of gymnasium and TorchRL refer to each other, so that this object may stay for long.
        for name in ("camera", "_large_camera", "model", "data", "_scratch"):
            self.__dict__.pop(name, None)
        self._close_simulator()

    def _check_open(self) -> None:
        if "camera" not in self.__dict__:
            raise RuntimeError("this environment is closed")

    # Goals and observations.

    @property
    def goal_position(self) -> np.ndarray:
        """The goal of the running episode, (D,) float32 metres."""
        return self._goal.copy()

    def set_goal(self, goal_position: np.ndarray | Sequence[float]) -> Observation:
        """Give the running episode another goal (D,), metres; what is seen with it.

        Raises:
            ValueError: for a goal outside the workspace.
        """
        self._check_open()
        self._goal = self._check_goal(goal_position)
        return self._observe(self.data)

    def move_object(self, position: np.ndarray | Sequence[float], object_index: int = 0) -> Observation:
        """Disturb the running episode: put an object somewhere else; what is seen then.

        An object that moves freely keeps its turn, and its coordinates on other axes. What is part of a robot is
        brought there with it, or as near as can be.

        Args:
            position: (D,) metres, in the workspace.
            object_index: Which object.

        Raises:
            ValueError: for a position outside the workspace, or an object that there is not.
        """
        self._check_open()
        place = self._check_goal(position)
        self._check_object(object_index)
        joint = self._free_joint(object_index)
        if joint is None:
            self._teleport(self.data, place, object_index)
        else:
            moved = place - self._relative(self._true_position(self.data))[object_index]
            address, speed = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
            self.data.qpos[address + np.array(self._axes)] += moved
            self.data.qvel[speed : speed + 6] = 0
        mujoco.mj_forward(self.model, self.data)
        observation = self._observe(self.data)
        self._last_seen = observation["object_position"]
        return observation

    def _free_joint(self, object_index: int) -> int | None:
        """The joint that lets an object move in all directions, if it has one."""
        body = self.model.body_rootid[self.model.geom_bodyid[self._geom_ids[object_index][0]]]
        joint = self.model.body_jntadr[body]
        return joint if joint >= 0 and self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE else None

    def goal_observation(self, goal_position: np.ndarray, object_index: int = 0) -> Observation:
        """What would be seen with an object at a goal; the running episode is not touched.

        Args:
            goal_position: (D,) metres. Where the robot cannot reach it, the nearest reachable position is shown.
            object_index: Which object; the others stay where they are.

        Returns:
            An observation with the keys of the environment, ``goal_position`` set to the goal.
        """
        self._check_open()
        goal = self._check_goal(goal_position)
        self._check_object(object_index)
        if self._scratch is None:
            self._scratch = mujoco.MjData(self.model)
        full = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, full))
        mujoco.mj_getState(self.model, self.data, state, full)
        mujoco.mj_setState(self.model, self._scratch, state, full)
        self._teleport(self._scratch, goal, object_index)
        mujoco.mj_forward(self.model, self._scratch)
        return self._observe(self._scratch, goal=goal)

    def _check_goal(self, goal_position: Any) -> np.ndarray:
        goal = self.workspace.check(goal_position)
        if goal.shape != (self.workspace.dim,):
            raise ValueError(f"one goal position of shape ({self.workspace.dim},) is needed, got {tuple(goal.shape)}")
        return goal.numpy()

    def _check_object(self, object_index: int) -> None:
        if not 0 <= object_index < len(self.objects):
            raise ValueError(
                f"object_index must be below {len(self.objects)}, the number of objects; got {object_index}"
            )

    def _observation_space(self) -> spaces.Dict:
        size, objects, dim = self.image_size, len(self.objects), self.workspace.dim

        def real(*shape: int) -> spaces.Box:
            return spaces.Box(-np.inf, np.inf, shape, np.float32)

        keys: dict[str, spaces.Space] = {
            "pixels": spaces.Box(0, 255, (3, size, size), np.uint8),
            "masks": spaces.Box(0, 1, (objects, size, size), np.bool_),
            "proprio": real(*self._proprio(self.data).shape),
            "object_position": real(objects, dim),
            "object_visible": spaces.Box(0, 1, (objects,), np.bool_),
            "goal_position": spaces.Box(*np.array([self.workspace.low, self.workspace.high], np.float32)),
        }
        if self.privileged:
            keys["object_position_true"] = real(objects, dim)
        return spaces.Dict(keys)

    def _observe(self, data: mujoco.MjData, goal: np.ndarray | None = None) -> Observation:
        check_physics(self.model, data)
        goal = self._goal if goal is None else goal
        pixels, masks, estimate, seen = self._nothing() if self.blind else self._look(data, goal)
        observation = {
            "pixels": pixels,
            "masks": masks,
            "proprio": self._proprio(data).astype(np.float32),
            "object_position": estimate if seen.all() else np.where(seen[:, None], estimate, self._last_seen),
            "object_visible": seen,
            "goal_position": goal.copy(),
        }
        if self.privileged:
            observation["object_position_true"] = self._relative(self._true_position(data))
        return observation

    def _look(self, data: mujoco.MjData, goal: np.ndarray) -> _Seen:
        wanted = None if self._colour_masks else [geom for ids in self._geom_ids for geom in ids]
        frame = self.camera.render(data, depth=self._plane is None, wanted=wanted)
        fine_masks = self._segment(frame, data)
        masks = fine_masks[:, self.mask_scale // 2 :: self.mask_scale, self.mask_scale // 2 :: self.mask_scale]
        world, visible = masks_to_positions(
            torch.from_numpy(fine_masks),
            self._mask_intrinsics,
            torch.from_numpy(self.camera.extrinsics(data)),
            depth=None if frame.depth is None else torch.from_numpy(frame.depth[None] + self.depth_offset),
            plane=self._plane,
        )
        pixels = frame.pixels
        if self.virtual_target:
            draw_target(pixels, self._project(goal, data), self.virtual_target, behind=masks.any(0))
        return pixels.transpose(2, 0, 1), masks.copy(), self._relative(world.numpy()), visible.numpy()

    def _segment(self, frame: Frame, data: mujoco.MjData) -> np.ndarray:
        """Masks (O, S * H, S * W), by colour if colours were learnt."""
        if self._colour_masks is None:
            return np.array([_any_of(frame.geoms, ids) for ids in self._geom_ids])
        return self._colour_masks.segment(self._fine_picture(data)).numpy()

    def _fine_picture(self, data: mujoco.MjData) -> torch.Tensor:
        return torch.from_numpy(self.camera.picture(data, fine=True)).movedim(-1, 0)

    def _learn_colours(self, frames: int) -> ColourMasks:
        """From goal observations of each object in turn, always the same."""
        places = np.random.default_rng(0).uniform(self.workspace.low, self.workspace.high, (frames, self.workspace.dim))
        self.reset(seed=0)
        pixels, masks = [], []
        for number, place in enumerate(places):
            self.goal_observation(place, number % len(self.objects))
            pixels.append(self._fine_picture(self._scratch))
            masks.append(torch.from_numpy(self._segment(self.camera.render(self._scratch), self._scratch)))
        self._np_random = self._np_random_seed = None  # a reset without a seed is random, as ever
        return ColourMasks.fit(torch.stack(pixels), torch.stack(masks))

    def _nothing(self) -> _Seen:
        shape, objects = (self.image_size, self.image_size), len(self.objects)
        hidden = np.zeros((objects, *shape), bool), np.zeros_like(self._last_seen), np.zeros(objects, bool)
        return np.zeros((3, *shape), np.uint8), *hidden

    def true_position(self) -> np.ndarray:
        """Where the objects are, (O, D) float32 metres from the start position: the simulator's own value."""
        return self._relative(self._true_position(self.data))

    def _relative(self, world: np.ndarray) -> np.ndarray:
        return (world - self._start)[:, self._axes].astype(np.float32)

    def _distance(self, observation: Observation) -> float:
        return math.dist(observation["object_position"][0], observation["goal_position"])

    def project(self, position: np.ndarray) -> np.ndarray:
        """Where a position (..., D), metres from the start, appears in the image: (..., 2) as (column, row)."""
        return self._project(position, self.data)

    def unproject(self, point: np.ndarray | Sequence[float], height: float = 0.0) -> np.ndarray:
        """Which position (..., D), metres from the start, appears at a point (..., 2) of the image, (column, row).

        The inverse of :meth:`project`. Positions with two axes lie in the plane of these axes through the start;
        those with three lie in a horizontal plane.

        Args:
            point: (..., 2) pixels.
            height: Of that plane above the start, metres; for positions with three axes.

        Raises:
            ValueError: for a point where the camera does not see the plane.
        """
        self._check_open()
        across = 2 if len(self._axes) == 3 else ({0, 1, 2} - set(self._axes)).pop()
        level = self._start[across] + (height if len(self._axes) == 3 else 0.0)
        plane = torch.tensor([*np.eye(3)[across], level])
        pixels, camera = torch.tensor(point, dtype=torch.float64), torch.from_numpy(self.camera.extrinsics(self.data))
        world = pixels_to_world(pixels.reshape(-1, 2), self._intrinsics.double(), camera.double(), plane=plane)
        if not world.isfinite().all():
            raise ValueError(f"the camera does not see the plane of the goals at {pixels.tolist()} (column, row)")
        relative = world.reshape(*pixels.shape[:-1], 3).numpy() - self._start
        return relative[..., self._axes].astype(np.float32)

    def _project(self, position: np.ndarray, data: mujoco.MjData) -> np.ndarray:
        world = np.broadcast_to(self._start, (*position.shape[:-1], 3)).copy()
        world[..., self._axes] += position
        pose = self.camera.extrinsics(data)
        in_camera = (world - pose[:3, 3]) @ pose[:3, :3]
        in_image = in_camera @ self._intrinsics.numpy().T
        return in_image[..., :2] / in_image[..., 2:]


def _any_of(geoms: np.ndarray, ids: list[int]) -> np.ndarray:
    mask = geoms == ids[0]
    for geom in ids[1:]:
        mask |= geoms == geom
    return mask
