"""The page in the browser, with Gradio: a camera to click into, and what the agent imagines beside it."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.play.errors import PlayError
from torchrl_ocwm.play.pictures import camera_picture, imagined_picture, masks_picture, numbers
from torchrl_ocwm.play.session import Session
from torchrl_ocwm.play.stage import Stage

with needs("the page", "play"):
    import gradio as gr

_HERE = Path(__file__).parent
_AXES = "xyz"
_NOTICE = 8  # seconds
_LEGEND = """\
**Click** into the large picture to set the goal, the red cross, inside the dashed line. **Drag** an object to move it.
Where positions have a height, both keep it. The sliders and buttons do the same, and the slider z moves the goal up and
down. The blue ring is where the world model believes the object to be, the brown one where it is in what the agent
imagined."""


class Page:
    """The page of a stage; ``Page(stage).launch()`` serves it.

    Everything it needs comes from this machine, and nothing is reported to anybody.

    Args:
        stage: What is shown. All who open the page see and steer the same simulation, which stands still while nobody
            has it open.
        rate: Steps per second, if the machine is fast enough.

    Attributes:
        blocks: Gradio's page.
    """

    def __init__(self, stage: Stage, *, rate: float = 10.0) -> None:
        self.stage, self.rate, self.running = stage, rate, True
        with gr.Blocks(title="torchrl_ocwm: play", analytics_enabled=False, delete_cache=(3600, 86400)) as self.blocks:
            gr.Markdown("# Play")
            self._lay_out()
            self._connect()

    def launch(self, *, host: str = "127.0.0.1", port: int | None = None, browser: bool = False) -> str:
        """Serve the page, in threads of its own.

        Args:
            host: Address to listen at. ``0.0.0.0`` opens it to the network: whoever reaches it can steer.
            port: Port; ``None`` for the first free one from 7860.
            browser: Open it in the browser of this machine.

        Returns:
            The page's address.

        Raises:
            PlayError: if the port is taken.
        """
        try:
            _, address, _ = self.blocks.launch(
                server_name=host,
                server_port=port,
                inbrowser=browser,
                prevent_thread_lock=True,
                share=False,
                ssr_mode=False,
                mcp_server=False,
                run_history=False,
                quiet=True,
                footer_links=[],
                _frontend=False,  # or Gradio gives up if this machine takes three seconds to answer it
                theme=_theme(),
                css_paths=_HERE / "page.css",
            )
        except OSError as error:
            raise PlayError(
                f"cannot serve at {host}, port {port} ({error}); choose another one with port=..."
            ) from error
        return address

    def close(self) -> None:
        """Stop serving. The stage stays."""
        self.blocks.close(verbose=False)

    # What is on it.

    def _lay_out(self) -> None:
        with gr.Row():
            with gr.Column(scale=2, min_width=300):
                script = (_HERE / "page.js").read_text(encoding="utf-8")
                self.camera = gr.HTML(js_on_load=script, elem_id="camera", apply_default_css=False)
                self.numbers = gr.HTML(elem_id="numbers", apply_default_css=False)
            with gr.Column(scale=1, min_width=120):
                gr.Markdown("**Imagined** since the goal was set")
                self.imagined = gr.HTML(elem_id="imagined", apply_default_css=False)
            with gr.Column(scale=1, min_width=120):
                gr.Markdown("**Decoded masks** of what it sees")
                self.masks = gr.HTML(elem_id="masks", apply_default_css=False)
        gr.Markdown(_LEGEND)
        with gr.Row():
            self.pause = gr.Button("Pause", elem_id="pause")
            self.episode = gr.Button("New episode", elem_id="episode")
            self.push = gr.Button("Move the object at random", elem_id="push")
        with gr.Row():
            self.sliders = [gr.Slider(-1, 1, elem_id=f"goal-{axis}", buttons=[]) for axis in _AXES]
        with gr.Row():
            self.environment = gr.Dropdown(self._environments(), label="Environment", elem_id="environment")
            self.agent = gr.Dropdown(self._agents(), label="Agent", elem_id="agent")
            self.behaviour = gr.Dropdown(
                self.stage.player.behaviours(), label="Behaviour (object)", elem_id="behaviour"
            )
        with gr.Accordion("Goal images", open=False) as self.images:
            self.as_image = gr.Checkbox(False, label="Give the agent clicked goals as images", elem_id="as-image")
            self.gallery = gr.Gallery(label="Pick a goal image", columns=5, allow_preview=False, elem_id="gallery")
            self.upload = gr.Image(label="Or drop one, as the camera makes them", type="numpy", sources=["upload"])
        self.timer = gr.Timer(1 / self.rate)

    def _connect(self) -> None:
        frame = [self.camera, self.numbers, self.imagined, self.masks]
        steered = [*frame, *self.sliders]
        everything = [*steered, self.pause, self.environment, self.agent, self.behaviour, self.images, self.gallery]
        quiet: dict[str, Any] = {"show_progress": "hidden", "api_visibility": "private"}
        self.blocks.load(self.all, None, everything, **quiet)
        self.timer.tick(self.tick, None, frame, **quiet)
        self.camera.click(self.click, self.as_image, steered, **quiet)
        self.camera.release(self.drag, None, steered, **quiet)
        for slider in self.sliders:
            slider.input(self.slide, [self.as_image, *self.sliders], frame, trigger_mode="always_last", **quiet)
        self.pause.click(self.toggle, None, self.pause, **quiet)
        self.episode.click(lambda: self.steer(Session.reset), None, steered, **quiet)
        self.push.click(lambda: self.steer(Session.move_object_at_random), None, steered, **quiet)
        self.environment.input(self.choose_environment, self.environment, everything, **quiet)
        self.agent.input(self.choose, self.agent, everything, **quiet)
        self.behaviour.input(self.choose, [self.agent, self.behaviour], everything, **quiet)
        self.gallery.select(self.pick, None, steered, **quiet)
        self.upload.upload(self.drop, self.upload, steered, **quiet)

    def _environments(self) -> list[str]:
        return list(dict.fromkeys(player.environment for player in self.stage.players.values()))

    def _agents(self) -> list[str]:
        here = self.stage.player.environment
        return [name for name, player in self.stage.players.items() if player.environment == here]

    # What happens.

    def tick(self) -> list[Any]:
        """A step, and what is to be seen then."""
        if not self.running:
            return [gr.skip()] * 4
        _warned(self.stage.do, Session.step)
        return self.frame()

    def toggle(self) -> str:
        """Stop, or go on; what the button says then."""
        self.running = not self.running
        return self._pause_label()

    def _pause_label(self) -> str:
        return "Pause" if self.running else "Go on"

    def click(self, as_image: bool, event: gr.EventData) -> list[Any]:
        """Set the goal to where somebody clicked, as high as it was."""

        def set_goal(session: Session) -> None:
            session.set_goal(session.places.position(event.to, session.env.goal_position), as_image=as_image)

        return self.steer(set_goal)

    def drag(self, event: gr.EventData) -> list[Any]:
        """Move the object that is nearest to where a drag began to where it ended, as high as it was."""

        def move(session: Session) -> None:
            name = session.places.nearest_object(event.begin)
            before = session.env.true_position()[list(session.env.objects).index(name)]
            session.move_object(session.places.position(event.to, before), name)

        return self.steer(move)

    def slide(self, as_image: bool, *centimetres: float) -> list[str]:
        """Set the goal to where the sliders are."""

        def set_goal(session: Session) -> None:
            position = np.array(centimetres[: session.env.workspace.dim]) / 100
            session.set_goal(position, as_image=as_image)

        _warned(self.stage.do, set_goal)
        return self.frame()

    def pick(self, event: gr.SelectData) -> list[Any]:
        """Set the goal to the image that was picked."""
        return self.steer(lambda session: session.set_goal(session.env.workspace.landmarks[event.index], as_image=True))

    def drop(self, image: np.ndarray) -> list[Any]:
        """Set the goal to an image of somebody else's."""
        return self.steer(lambda session: session.set_goal_image(image))

    def choose_environment(self, environment: str) -> list[Any]:
        """Let the first agent of an environment act."""
        names = [name for name, player in self.stage.players.items() if player.environment == environment]
        return self.choose(names[0])

    def choose(self, agent: str, behaviour: str | None = None) -> list[Any]:
        """Let another agent act, or another of its behaviours."""
        _warned(self.stage.choose, agent, behaviour)
        return self.all()

    def steer(self, action: Callable[[Session], None]) -> list[Any]:
        """Do something with the session, and what is to be seen then."""
        _warned(self.stage.do, action)
        return [*self.frame(), *self.stage.do(_sliders)]

    # What is to be seen.

    def frame(self) -> list[str]:
        """Pictures and numbers."""
        view = self.stage.do(Session.view)
        return [camera_picture(view), numbers(view), imagined_picture(view), masks_picture(view)]

    def all(self) -> list[Any]:
        """Pictures, numbers and what there is to choose from."""
        player, behaviours = self.stage.player, self.stage.player.behaviours()
        takes_images = self.stage.do(lambda session: session.takes_images)
        return [
            *self.frame(),
            *self.stage.do(_sliders),
            self._pause_label(),
            player.environment,
            gr.Dropdown(self._agents(), value=player.name),
            gr.Dropdown(behaviours, value=self.stage.behaviour or behaviours[0][1]),
            gr.Accordion(visible=takes_images),
            gr.Gallery(self.stage.do(Session.goal_pictures) if takes_images else []),
        ]


def _sliders(session: Session) -> list[Any]:
    """The sliders of the goal, in centimetres, as the environment has axes."""
    workspace, axes = session.env.workspace, session.env.axes
    goal = session.env.goal_position
    shown = [
        gr.Slider(
            100 * low, 100 * high, value=round(100 * at, 1), step=0.5, label=f"Goal {_AXES[axis]}, cm", visible=True
        )
        for low, high, at, axis in zip(workspace.low, workspace.high, goal.tolist(), axes, strict=True)
    ]
    return shown + [gr.Slider(visible=False)] * (len(_AXES) - len(shown))


def _warned(function: Callable[..., Any], *arguments: Any) -> None:
    """Show what a user can mend; all else is an error of ours."""
    try:
        function(*arguments)
    except UserError as error:
        gr.Warning(escape(str(error)), duration=_NOTICE, title="Not possible")


def _theme() -> gr.themes.Base:
    """Fonts of the system: others would be loaded from the net."""
    return gr.themes.Base(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])
