"""MuJoCo's off-screen OpenGL contexts, and the one message for a machine that has no working OpenGL library."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import sys
import weakref
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from torchrl_ocwm.envs.missing import missing
from torchrl_ocwm.errors import UserError

#: Everything that holds an OpenGL context and has a ``close`` method.
OPEN: weakref.WeakSet[Any] = weakref.WeakSet()


class RenderingError(UserError, RuntimeError):
    """There is no OpenGL library that works here; the message says what installs one."""


def import_mujoco() -> Any:
    """Import MuJoCo, which loads the OpenGL library that ``MUJOCO_GL`` names.

    Raises:
        MissingPackageError: if MuJoCo is not installed, with the extra to install.
        RenderingError: if the OpenGL library is missing, with what to install.
    """
    if find_spec("mujoco") is None:
        raise missing("rendering", "mujoco", "dm-control")
    try:
        return import_module("mujoco")
    except Exception as error:  # PyOpenGL fails in many ways when its library is missing
        raise renderer_error(error) from error


@cache
def context_class() -> Any:
    """MuJoCo's OpenGL context class. MuJoCo's own default needs a screen; without one this takes EGL."""
    mujoco = import_mujoco()
    if multiprocessing.parent_process() is not None:
        # Workers of a pool share the cores: Mesa's software renderer must not start threads in each of them.
        os.environ.setdefault("LP_NUM_THREADS", "0")
    library = os.environ.get("MUJOCO_GL", "").lower().strip()
    if not library and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        library = "egl"
    return import_module(f"mujoco.{library}").GLContext if library in ("egl", "osmesa") else mujoco.GLContext


def close_at_exit(holder: Any) -> None:
    """Call ``holder.close()`` when the interpreter ends, unless it is gone by then."""
    OPEN.add(holder)
    _register_exit()


@cache
def _register_exit() -> None:
    # MuJoCo registers OpenGL's own shut-down with the first context; what is registered later runs earlier.
    atexit.register(_close_all)


def renderer_error(error: BaseException) -> RenderingError:
    """What to install, on one line."""
    reason = " ".join(str(error).split()) or "no details"
    remedy = (
        "Install a software renderer: `apt-get install libegl1 libgl1-mesa-dri` for MUJOCO_GL=egl (the default), or "
        "`apt-get install libosmesa6` for MUJOCO_GL=osmesa."
        if sys.platform.startswith("linux")
        else "Leave MUJOCO_GL unset, so that MuJoCo takes this system's own OpenGL."
    )
    library = os.environ.get("MUJOCO_GL", "")
    return RenderingError(
        f"MuJoCo cannot render off screen ({type(error).__name__}: {reason}; MUJOCO_GL={library!r}). {remedy}"
    )


def _close_all() -> None:
    for holder in list(OPEN):
        holder.close()
