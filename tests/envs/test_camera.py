"""One camera for colours, segmentation and depth, checked on a scene whose picture is known."""

import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import mujoco
import numpy as np
import pytest

from torchrl_ocwm.envs import Camera

# A floor, a box whose top is 30 cm above it, and a mirror; the camera looks straight down from one metre.
SCENE = """
<mujoco>
  <asset><material name="mirror" rgba=".2 .2 .2 1" reflectance=".9"/></asset>
  <worldbody>
    <light pos=".8 0 1.5" dir="-.6 0 -1" castshadow="true"/>
    <camera name="top" pos="0 0 1" fovy="90"/>
    <camera name="tilted" pos=".3 -.9 .8" xyaxes="1 .2 0 -.1 .5 .8" fovy="60"/>
    <geom name="floor" type="plane" size="2 2 .1" material="mirror"/>
    <geom name="box" type="box" size=".1 .1 .15" pos="-.4 .3 .15" rgba="1 0 0 1"/>
    <geom name="ball" type="sphere" size=".05" pos=".2 -.1 .4" rgba="0 1 0 1"/>
  </worldbody>
</mujoco>
"""
FLOOR, BOX, BALL = 0, 1, 2
HEIGHT, WIDTH = 80, 100


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SCENE)


@pytest.fixture(scope="module")
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture
def open_camera(model):
    cameras = []

    def make(name="top", **options):
        cameras.append(Camera(model, name, **{"height": HEIGHT, "width": WIDTH, **options}))
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()


def pixel_of(x: float, y: float, z: float) -> tuple[int, int]:
    """Row and column of a point seen by the camera "top": 90 degrees over 80 rows are 40 pixels of focal length."""
    return int(HEIGHT / 2 - 40 * y / (1 - z)), int(WIDTH / 2 + 40 * x / (1 - z))


def test_one_render_gives_colours_segments_and_depth(open_camera, data):
    frame = open_camera().render(data, depth=True)
    assert (frame.pixels.shape, frame.pixels.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)
    assert (frame.geoms.shape, frame.geoms.dtype) == ((HEIGHT, WIDTH), np.int32)
    assert (frame.depth.shape, frame.depth.dtype) == ((HEIGHT, WIDTH), np.float32)


def test_a_picture_is_the_colours_alone(open_camera, data):
    camera = open_camera("tilted")
    picture = camera.picture(data)
    assert np.array_equal(picture, camera.render(data).pixels)
    assert picture.std() > 1


def test_segments_are_where_the_geoms_are(open_camera, data):
    geoms = open_camera().render(data).geoms
    assert geoms[pixel_of(-0.4, 0.3, 0.3)] == BOX
    assert geoms[pixel_of(0.2, -0.1, 0.4)] == BALL
    assert geoms[pixel_of(0.2, 0.3, 0.0)] == FLOOR
    # The top of the box spans 20 cm at 70 cm distance; its sides hide some more of the floor.
    columns = np.unique(np.nonzero(geoms == BOX)[1])
    assert columns.min() == round(WIDTH / 2 + 40 * -0.5 / 0.7)
    assert columns.max() == round(WIDTH / 2 + 40 * -0.3 / 1.0) - 1


def test_colours_are_those_of_the_geoms(open_camera, data):
    pixels = open_camera().render(data).pixels.astype(int)
    red, green = pixels[pixel_of(-0.4, 0.3, 0.3)], pixels[pixel_of(0.2, -0.1, 0.4)]
    assert red[0] > 5 * max(red[1], red[2])
    assert green[1] > 5 * max(green[0], green[2])


def test_nothing_is_minus_one(open_camera, data):
    geoms = open_camera("tilted").render(data).geoms
    assert (geoms[0] == -1).all()  # the sky above the floor
    assert set(np.unique(geoms)) == {-1, FLOOR, BOX, BALL}


def test_depth_is_metres_along_the_axis(open_camera, data):
    frame = open_camera().render(data, depth=True)
    # The same in the middle and in the corner: along the axis, not along the ray.
    assert frame.depth[frame.geoms == FLOOR] == pytest.approx(1.0, abs=1e-3)
    assert frame.depth[pixel_of(-0.4, 0.3, 0.3)] == pytest.approx(0.7, abs=1e-3)
    assert frame.depth[frame.geoms == BALL].min() == pytest.approx(0.55, abs=2e-3)


def test_depth_only_when_asked_for(open_camera, data):
    camera = open_camera()
    with_depth, without = camera.render(data, depth=True), camera.render(data)
    assert without.depth is None
    assert np.array_equal(with_depth.pixels, without.pixels)
    assert np.array_equal(with_depth.geoms, without.geoms)


def test_frames_are_copies(open_camera, model, data):
    camera = open_camera()
    before = camera.render(data, depth=True)
    kept = [part.copy() for part in before]
    moved = mujoco.MjData(model)
    moved.geom_xpos[:] = data.geom_xpos[::-1]
    moved.cam_xpos[:], moved.cam_xmat[:] = data.cam_xpos + 0.1, data.cam_xmat
    after = camera.render(moved, depth=True)
    for old, kept_old, new in zip(before, kept, after, strict=True):
        assert np.array_equal(old, kept_old)
        assert not np.array_equal(old, new)


@pytest.mark.parametrize("name", ["top", "tilted"])
def test_matrices_say_where_the_pixels_lie(open_camera, model, data, name):
    """The ball's pixels, unprojected at their depth, lie on the ball."""
    camera = open_camera(name)
    frame = camera.render(data, depth=True)
    rows, columns = np.nonzero(frame.geoms == BALL)
    depth = frame.depth[rows, columns]
    homogeneous = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    in_camera = np.linalg.inv(camera.intrinsics) @ homogeneous * depth
    pose = camera.extrinsics(data)
    in_world = (pose[:3, :3] @ in_camera).T + pose[:3, 3]
    distance = np.linalg.norm(in_world - data.geom_xpos[BALL], axis=1)
    assert distance == pytest.approx(0.05, abs=3e-3)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("effect", [{"shadows": True}, {"reflections": True}, {"multisampling": 4}])
def test_effects_are_off_by_default(open_camera, data, effect):
    off = dict.fromkeys(effect, 0)
    default, without, with_effect = (open_camera(**options).render(data) for options in ({}, off, effect))
    assert np.array_equal(default.pixels, without.pixels)
    assert not np.array_equal(default.pixels, with_effect.pixels)
    assert np.array_equal(default.geoms, with_effect.geoms)


def test_model_keeps_its_rendering_settings(open_camera, model):
    model.vis.global_.offwidth, model.vis.quality.offsamples, model.vis.quality.shadowsize = 333, 4, 1024
    open_camera()
    quality = model.vis.quality
    assert (model.vis.global_.offwidth, quality.offsamples, quality.shadowsize) == (333, 4, 1024)


def test_geoms_that_turn_transparent_disappear(open_camera, model, data):
    camera = open_camera()
    assert (camera.render(data).geoms == BOX).any()
    colour = model.geom_rgba[BOX].copy()
    try:
        model.geom_rgba[BOX, 3] = 0
        frame = camera.render(data)
    finally:
        model.geom_rgba[BOX] = colour
    assert frame.geoms[pixel_of(-0.4, 0.3, 0.3)] == FLOOR
    assert frame.geoms[pixel_of(0.2, -0.1, 0.4)] == BALL
    assert (camera.render(data).geoms == BOX).any()


def test_more_geoms_than_a_byte_can_count():
    balls = "".join(f'<geom size=".02" pos="{i % 20 * 0.05} {i // 20 * 0.05} 0"/>' for i in range(400))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><camera name="top" pos=".475 .475 1.5"/>{balls}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = Camera(model, "top", height=256, width=256)
    geoms = camera.render(data).geoms
    focal = 128 / np.tan(np.deg2rad(22.5))
    for ball in range(400):
        x, y = data.geom_xpos[ball, :2] - 0.475
        assert geoms[int(128 - focal * y / 1.5), int(128 + focal * x / 1.5)] == ball
    camera.close()


# What a camera file can say of the lens: metres of the sensor, of its focal lengths and of its principal point.
LENS = 'sensorsize=".02 .015" focal=".012 .014" principal=".002 -.001" resolution="100 80"'


def test_sensor_focal_length_and_principal_point():
    """Small balls appear where the lens puts them: u = W/2 + W/w (f x/z - c), v = H/2 - H/h (f y/z - c)."""
    points = np.array([[0.1, 0.2, 0.0], [-0.4, -0.1, 0.1], [0.5, -0.3, 0.2], [-0.2, 0.3, -0.1]])
    balls = "".join(f'<geom size=".03" pos="{x} {y} {z}"/>' for x, y, z in points)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><camera name="lens" pos="0 0 1" {LENS}/>{balls}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = Camera(model, "lens", height=HEIGHT, width=WIDTH, mask_scale=4)
    geoms = camera.render(data).geoms
    for ball, (x, y, z) in enumerate(points):
        column = WIDTH / 2 + WIDTH / 0.02 * (0.012 * x / (1 - z) - 0.002)
        row = HEIGHT / 2 - HEIGHT / 0.015 * (0.014 * y / (1 - z) + 0.001)
        seen = np.argwhere(geoms == ball).mean(0) + 0.5
        assert seen / 4 == pytest.approx([row, column], abs=0.3)
        homogeneous = camera.intrinsics @ [x / (1 - z), -y / (1 - z), 1.0]
        assert homogeneous == pytest.approx([column, row, 1.0], abs=1e-3)
    camera.close()


def test_orthographic_cameras_are_refused():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><camera name="flat" orthographic="true" fovy="2"/></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match="camera 'flat' is orthographic"):
        Camera(model, "flat")


def test_more_geoms_than_a_picture_has_room_for(open_camera, data):
    assert (open_camera(max_geoms=3).render(data).geoms == BALL).any()
    with pytest.raises(ValueError, match="more than 2 geoms; give the camera a larger max_geoms"):
        open_camera(max_geoms=2).render(data)


@pytest.mark.parametrize("number", [0, 65536])
def test_max_geoms_is_bounded(open_camera, number):
    with pytest.raises(ValueError, match=f"max_geoms must be from 1 to 65535, got {number}"):
        open_camera(max_geoms=number)


def test_a_camera_belongs_to_its_thread(open_camera, data):
    camera = open_camera()
    before = camera.render(data)
    with ThreadPoolExecutor(1) as other:
        for use in (lambda: camera.render(data), camera.close):
            with pytest.raises(RuntimeError, match="belongs to the thread 'MainThread'.*in one thread"):
                other.submit(use).result()
    assert np.array_equal(camera.render(data).pixels, before.pixels)


def test_a_camera_of_another_thread(model, data):
    """A thread that makes a camera of its own can use it."""

    def look():
        with closing(Camera(model, "top", height=HEIGHT, width=WIDTH)) as camera:
            return camera.render(data)

    with ThreadPoolExecutor(1) as other:
        assert (other.submit(look).result().geoms == BALL).any()


def test_a_camera_that_python_collects_in_another_thread(model, monkeypatch):
    """It says nothing, as nobody could mend that there; in its own thread it is freed."""
    said = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    cameras = [Camera(model, "top", height=HEIGHT, width=WIDTH)]
    with ThreadPoolExecutor(1) as other:
        other.submit(cameras.clear).result()
    assert not said
    camera = Camera(model, "top", height=HEIGHT, width=WIDTH)
    closed = []
    monkeypatch.setattr(Camera, "close", lambda camera: closed.append(camera))
    camera.__del__()
    assert closed == [camera]
    monkeypatch.undo()
    camera.close()


def test_unknown_camera_lists_those_there_are(model):
    with pytest.raises(ValueError, match=r"no camera 'side'; it has \['top', 'tilted'\]"):
        Camera(model, "side")


def test_closed_camera_says_so(open_camera, data):
    camera = open_camera()
    camera.render(data)
    camera.close()
    camera.close()
    with pytest.raises(RuntimeError, match="this camera is closed"):
        camera.render(data)


def test_closing_a_camera_leaves_the_others_alone(open_camera, model, data):
    first, second = open_camera(), open_camera("tilted")
    second.render(data)
    before = first.render(data, depth=True)
    empty = mujoco.MjData(model)  # all geoms at the origin
    first.render(empty, depth=True)
    second.close()  # while the first is the one in use
    after = first.render(data, depth=True)
    for old, new in zip(before, after, strict=True):
        assert np.array_equal(old, new)


def test_a_fine_picture_is_that_of_a_larger_camera(open_camera, data):
    camera, large = open_camera(mask_scale=3), open_camera(height=3 * HEIGHT, width=3 * WIDTH)
    assert np.array_equal(camera.picture(data, fine=True), large.picture(data))
    frame = camera.render(data)  # which uses the same buffers
    assert np.array_equal(frame.geoms, large.render(data).geoms)
    assert np.array_equal(frame.pixels, open_camera().picture(data))
