"""A machine without a working OpenGL library gets one line that says what to install."""

import importlib
import sys

import mujoco
import pytest

from torchrl_ocwm.envs import opengl
from torchrl_ocwm.envs import shared_context as context_module
from torchrl_ocwm.envs.camera import Camera

MODEL = mujoco.MjModel.from_xml_string('<mujoco><worldbody><camera name="top"/></worldbody></mujoco>')


class BrokenContext:
    def __init__(self, width, height):
        raise ImportError("libEGL.so.1: cannot open\n   shared object file")


def assert_says_what_to_install(message: str) -> None:
    assert "\n" not in message
    assert "apt-get install libegl1" in message
    assert "MUJOCO_GL=egl" in message


def test_context_that_cannot_be_made(monkeypatch):
    monkeypatch.setattr(context_module, "context_class", lambda: BrokenContext)
    before = MODEL.vis.global_.offwidth
    with pytest.raises(RuntimeError, match=r"ImportError: libEGL\.so\.1: cannot open shared object file") as caught:
        Camera(MODEL, "top")
    assert_says_what_to_install(str(caught.value))
    assert isinstance(caught.value.__cause__, ImportError)
    assert MODEL.vis.global_.offwidth == before


def test_what_was_opened_before_the_failure_is_freed(monkeypatch):
    freed = []

    class Opened:
        def __init__(self, width, height):
            pass

        def make_current(self):
            raise RuntimeError("no more memory")

        def free(self):
            freed.append(self)

    monkeypatch.setattr(context_module, "context_class", lambda: Opened)
    with pytest.raises(RuntimeError, match=r"RuntimeError: no more memory"):
        Camera(MODEL, "top")
    assert len(freed) == 1


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_on_other_systems(monkeypatch, system):
    monkeypatch.setattr(sys, "platform", system)
    message = str(opengl.renderer_error(RuntimeError("invalid value for environment variable MUJOCO_GL: egl")))
    assert message.endswith("Leave MUJOCO_GL unset, so that MuJoCo takes this system's own OpenGL.")
    assert "apt-get" not in message


def test_import_that_fails(monkeypatch):
    def fail(name):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(opengl, "import_module", fail)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(
        RuntimeError, match=r"cannot render off screen \(AttributeError: .*MUJOCO_GL='osmesa'"
    ) as caught:
        opengl.import_mujoco()
    assert_says_what_to_install(str(caught.value))


def test_error_without_a_text():
    assert "(OSError: no details;" in str(opengl.renderer_error(OSError()))


def test_missing_mujoco(monkeypatch):
    monkeypatch.setattr(opengl, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-ocwm\[dm-control\]'"):
        opengl.import_mujoco()


@pytest.mark.parametrize(
    ("environment", "module"),
    [
        ({"MUJOCO_GL": "egl"}, "mujoco.egl"),
        ({"MUJOCO_GL": " OSMesa "}, "mujoco.osmesa"),
        pytest.param({}, "mujoco.egl", marks=pytest.mark.skipif(sys.platform != "linux", reason="Linux only")),
        ({"MUJOCO_GL": "", "DISPLAY": ":0"}, None),
    ],
)
def test_which_library_is_taken(monkeypatch, environment, module):
    for name in ("MUJOCO_GL", "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    asked = []

    def remember(name):
        asked.append(name)
        return importlib.import_module("mujoco")

    monkeypatch.setattr(opengl, "import_module", remember)
    monkeypatch.setattr(mujoco, "GLContext", "the default", raising=False)
    assert opengl.context_class.__wrapped__() == "the default"
    assert asked == ["mujoco", *([module] if module else [])]


def test_everything_open_is_closed_at_exit():
    class Holder:
        closed = 0

        def close(self):
            self.closed += 1

    kept, gone = Holder(), Holder()
    opengl.OPEN.add(kept)
    opengl.OPEN.add(gone)
    del gone
    open_before = set(opengl.OPEN) - {kept}
    for other in open_before:
        opengl.OPEN.discard(other)
    try:
        opengl._close_all()
    finally:
        opengl.OPEN.update(open_before)
        opengl.OPEN.discard(kept)
    assert kept.closed == 1
