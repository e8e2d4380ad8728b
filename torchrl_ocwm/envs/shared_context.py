"""MuJoCo's rendering contexts, one for all cameras of a thread that see the same model."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np

from torchrl_ocwm.envs.opengl import context_class, import_mujoco, renderer_error

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = import_mujoco()

_Key = tuple[int, threading.Thread, bytes]


class SharedContext:
    """An OpenGL context with the meshes and textures of a model.

    To make one takes as long as a hundred frames, so that cameras share it (:func:`shared_context`).

    Args:
        model: The MuJoCo model; says the size of the buffers, their samples and whether there is a map for shadows.

    Raises:
        RenderingError: if no OpenGL library works, with what to install.

    Attributes:
        mujoco: What MuJoCo's rendering functions take.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.holders = 0
        size, gl = model.vis.global_, None
        try:
            gl = self._gl = context_class()(size.offwidth, size.offheight)
            gl.make_current()
            self.mujoco: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # each OpenGL binding raises an error class of its own
            if gl is not None:
                gl.free()
            raise renderer_error(error) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.mujoco)
        self.mujoco.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def make_current(self) -> None:
        """Let OpenGL work in it, in the thread that made it."""
        self._gl.make_current()

    def release(self) -> None:
        """One holder less; the last one frees it, in the thread that made it."""
        self.holders -= 1
        if self.holders:
            return
        self.make_current()  # it would free the buffers of whichever context was used last
        self.mujoco.free()
        self._gl.free()
        for key, context in list(_CONTEXTS.items()):
            if context is self:
                del _CONTEXTS[key]


_CONTEXTS: WeakValueDictionary[_Key, SharedContext] = WeakValueDictionary()


def shared_context(
    model: mujoco.MjModel, *, height: int, width: int, multisampling: int = 0, shadows: bool = False
) -> SharedContext:
    """The context of this thread for such a model, with one holder more.

    Args:
        model: The MuJoCo model.
        height: Of the buffers, pixels.
        width: Of the buffers, pixels.
        multisampling: Samples per pixel, 0 for none.
        shadows: Whether shadows can be drawn. Their map takes tens of MiB.

    Raises:
        RenderingError: if no OpenGL library works, with what to install.

    Examples:
        >>> import mujoco
        >>> models = [mujoco.MjModel.from_xml_string("<mujoco/>") for _ in range(2)]
        >>> one, two = (shared_context(model, height=8, width=8) for model in models)
        >>> one is two
        True
        >>> one.release(), two.release()
        (None, None)
    """
    with _prepared(model, height, width, multisampling, shadows):
        key = os.getpid(), threading.current_thread(), _digest(model)  # a forked process inherits none that works
        if (context := _CONTEXTS.get(key)) is None:
            context = _CONTEXTS[key] = SharedContext(model)
    context.holders += 1
    return context


@contextmanager
def _prepared(model: mujoco.MjModel, height: int, width: int, multisampling: int, shadows: bool) -> Iterator[None]:
    """A context takes all this from the model, which is unchanged afterwards."""
    quality, size = model.vis.quality, model.vis.global_
    before = quality.offsamples, quality.shadowsize, size.offwidth, size.offheight
    quality.offsamples, size.offwidth, size.offheight = multisampling, width, height
    if not shadows:
        quality.shadowsize = 0
    try:
        yield
    finally:
        quality.offsamples, quality.shadowsize, size.offwidth, size.offheight = before


def _digest(model: mujoco.MjModel) -> bytes:
    """Of all that is in a model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return sha256(buffer.data).digest()
