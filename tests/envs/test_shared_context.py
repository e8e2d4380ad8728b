"""Cameras share an OpenGL context where they can, and nowhere else."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing

import mujoco
import numpy as np
import pytest

from torchrl_ocwm.envs import find_environment, make_scene
from torchrl_ocwm.envs import shared_context as context_module
from torchrl_ocwm.envs.camera import Camera
from torchrl_ocwm.envs.shared_context import shared_context

SIZE = {"height": 16, "width": 16}


def make_model(colour: str = "1 0 0", height: float = 1.0) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco>
          <asset><texture name="t" type="2d" builtin="flat" rgb1="{colour}" width="4" height="4"/>
            <material name="m" texture="t"/></asset>
          <worldbody><camera name="top" pos="0 0 {height}"/><light pos="0 0 1"/>
            <body><freejoint/><geom type="box" size=".2 .2 .2" material="m"/></body></worldbody></mujoco>"""
    )


def pixels_of(camera: Camera, model: mujoco.MjModel, x: float = 0.0) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[0] = x
    mujoco.mj_forward(model, data)
    return camera.render(data).pixels


@pytest.mark.parametrize(
    "other",
    [{"height": 17}, {"width": 17}, {"multisampling": 4}, {"shadows": True}],
    ids=lambda other: next(iter(other)),
)
def test_equal_models_share_a_context_if_it_would_be_the_same(other):
    one, same = shared_context(make_model(), **SIZE), shared_context(make_model(), **SIZE)
    different = shared_context(make_model(), **{**SIZE, **other})
    assert one is same
    assert different is not one
    for context in (one, same, different):
        context.release()


def test_models_that_look_different_do_not_share():
    red, green = make_model("1 0 0"), make_model("0 1 0")
    with closing(Camera(red, "top", **SIZE)) as one, closing(Camera(green, "top", **SIZE)) as two:
        assert pixels_of(one, red)[8, 8].argmax() == 0
        assert pixels_of(two, green)[8, 8].argmax() == 1
        assert one._context is not two._context


def test_cameras_that_share_see_their_own_states():
    models = [make_model() for _ in range(2)]
    alone = []
    for model, x in zip(models, (-0.3, 0.3), strict=True):
        with closing(Camera(model, "top", **SIZE)) as camera:
            alone.append(pixels_of(camera, model, x))
    with closing(Camera(models[0], "top", **SIZE)) as one, closing(Camera(models[1], "top", **SIZE)) as two:
        assert one._context is two._context
        for _ in range(2):
            assert np.array_equal(pixels_of(one, models[0], -0.3), alone[0])
            assert np.array_equal(pixels_of(two, models[1], 0.3), alone[1])
    assert not np.array_equal(*alone)


def test_the_last_holder_frees_it(monkeypatch):
    model = make_model()
    one, two = Camera(model, "top", **SIZE), Camera(model, "top", **SIZE)
    context, before = one._context, pixels_of(two, model)
    one.close()
    one.close()
    assert context.holders == 1
    assert np.array_equal(pixels_of(two, model), before)
    two.close()
    assert context.holders == 0
    freed = []
    monkeypatch.setattr(type(context._gl), "free", lambda gl: freed.append(gl))
    with closing(Camera(model, "top", **SIZE)) as third:  # it does not find what has been freed
        assert third._context is not context
        own = third._context._gl
    assert freed == [own]
    monkeypatch.undo()
    own.free()


def test_no_other_thread_shares_it():
    here = shared_context(make_model(), **SIZE)

    def there() -> bool:
        context = shared_context(make_model(), **SIZE)
        try:
            return context is here
        finally:
            context.release()

    with ThreadPoolExecutor(1) as other:
        assert not other.submit(there).result()
    here.release()


def test_no_forked_process_shares_it(monkeypatch):
    here = shared_context(make_model(), **SIZE)
    with monkeypatch.context() as patch:
        patch.setattr(context_module.os, "getpid", lambda: -1)
        there = shared_context(make_model(), **SIZE)
    assert there is not here
    there.release()
    here.release()


def test_environments_of_a_process_share_it():
    with ExitStack() as stack:
        one, two, other = (
            stack.enter_context(closing(make_scene(find_environment("reacher"), image_size=size)))
            for size in (16, 16, 32)
        )
        assert one.camera._context is two.camera._context
        assert other.camera._context is not one.camera._context
