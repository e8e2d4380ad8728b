"""Geoms that cannot be in a picture are not drawn: which these are, by hand, and pictures with and without them."""

import mujoco
import numpy as np
import pytest
from observations import assert_same

from torchrl_ocwm.envs import Camera, CubeMove, PickPlace, Reacher, ShelfPlace
from torchrl_ocwm.envs import camera as camera_module
from torchrl_ocwm.envs.culling import culled_geoms

# One metre above the origin, looking down: x to the right, y up in the image, 90 degrees.
FROM_ABOVE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
WINDOW = np.array([[-1.0, -1.0], [1.0, 1.0]])
BALL = '<geom name="ball" size=".1"/>'  # it ends at a height of -0.1, and is 5.739 degrees large from the middle


def culled(geom, wanted=None, window=WINDOW):
    """Whether a geom is, beside a ball in the middle of the picture."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{BALL}{geom}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return bool(culled_geoms(model, data, FROM_ABOVE, window, wanted=wanted)[1])


def box(position, turn="0 0 0", size=".1 .1 .1"):
    return f'<geom type="box" size="{size}" pos="{position}" euler="{turn}"/>'


# The sides of the picture are x = ±(1 - z) and y = ±(1 - z). The corner nearest to one at x = 1 + a + b of a box whose
# half edges are 0.1 is at x = a + 0.9 + b and z = -0.1, where the side is at 1.1.
@pytest.mark.parametrize("side", ["{} 0 0", "-{} 0 0", "0 {} 0", "0 -{} 0"])
@pytest.mark.parametrize(("middle", "out"), [(1.199, False), (1.201, True)])
def test_boxes_beside_the_picture(side, middle, out):
    assert culled(box(side.format(middle))) is out


@pytest.mark.parametrize(("height", "out"), [(1.099, False), (1.101, True)])
def test_boxes_behind_the_camera(height, out):
    assert culled(box(f"0 0 {height}")) is out


# Turned by 45 degrees about y, the lowest corner is 0.1 sqrt(2) below the middle, and the leftmost at its height.
@pytest.mark.parametrize(("middle", "out"), [(1.141, False), (1.142, True)])
def test_turned_boxes(middle, out):
    assert culled(box(f"0 0 {middle}", turn="0 45 0")) is out


@pytest.mark.parametrize(("height", "out"), [(0.999, False), (1.001, True)])
def test_the_box_of_a_mesh_is_not_around_the_middle_of_its_frame(height, out):
    """MuJoCo takes the centre of mass, which is at a quarter of this pyramid's height; the box ends at its base."""
    mesh = '<mesh name="pyramid" vertex="-.1 -.05 0 .1 -.05 0 -.1 .05 0 .1 .05 0 0 0 .4"/>'
    geom = f'<geom type="mesh" mesh="pyramid" pos="0 0 {height}"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><asset>{mesh}</asset><worldbody>{geom}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert culled_geoms(model, data, FROM_ABOVE, WINDOW).tolist() == [out]


def test_a_plane_has_no_end():
    """It counts as all that is below it."""
    floor = '<geom type="plane" size="1 1 1" pos="9 9 -1"/>'
    assert not culled(floor)
    assert culled(floor, wanted=[0])  # behind the ball, all of it
    assert not culled('<geom type="plane" size="1 1 1" pos="9 9 -1" euler="180 0 0"/>', wanted=[0])  # upside down
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{box('.5 0 0')}{BALL}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert not culled_geoms(model, data, FROM_ABOVE, WINDOW, wanted=[0]).any()


def test_a_window_need_not_be_in_the_middle():
    window = np.array([[-1.0, -1.0], [0.5, 0.25]])
    for place, out in {"-1.1 0 0": False, ".8 0 0": True, "0 -.5 0": True, "0 1.1 0": False}.items():
        assert culled(box(place), window=window) is out, place  # the rows of an image run against y


# The ball is within 0.1005 = tan(5.739°) of the middle, and its far side is 1.1 metres away.
@pytest.mark.parametrize(
    ("geom", "out"),
    [
        (box("0 0 .5"), False),  # between the ball and the camera
        (box(".14 0 .5"), False),  # its lower corner at x = 0.04, z = 0.4; the side of the window at 0.0603
        (box(".17 0 .5"), True),  # the same corner at x = 0.07
        (box("0 -.17 .5"), True),
        (box("0 0 -.199"), False),  # its top above the bottom of the ball
        (box("0 0 -.201"), True),  # behind all of the ball
        (box(".5 0 0"), True),  # in the picture, but beside the ball
    ],
)
def test_what_cannot_hide_a_wanted_geom(geom, out):
    assert culled(geom, wanted=[0]) is out


def test_several_wanted_geoms_span_one_window():
    """A ball on the other side widens it to both, and its far side is where it ends."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{BALL}<geom size=".1" pos=".6 0 -.3"/>{box(".3 0 0")}{box(".3 0 -.49")}{box(".3 0 -.51")}'
        f"{box('-.3 0 0')}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert culled_geoms(model, data, FROM_ABOVE, WINDOW, wanted=[0, 1]).tolist() == [*[False] * 4, True, True]
    assert culled_geoms(model, data, FROM_ABOVE, WINDOW, wanted=[0]).tolist() == [False, *[True] * 5]


def test_a_camera_within_a_wanted_geom_sees_it_on_all_sides():
    around = '<geom name="hall" size="2"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{around}{box('.5 0 -3')}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert culled_geoms(model, data, FROM_ABOVE, WINDOW, wanted=[0]).tolist() == [False, False]


@pytest.fixture
def everything(monkeypatch):
    """From now on cameras draw all there is."""

    def draw_all():
        monkeypatch.setattr(camera_module, "culled_geoms", lambda model, *_, **__: np.zeros(model.ngeom, bool))

    return draw_all


def random_scene(seed, options=""):
    """Geoms of every kind all around a camera that looks anywhere."""
    rng = np.random.default_rng(seed)
    kinds = [
        'type="sphere"',
        'type="box"',
        'type="capsule"',
        'type="ellipsoid"',
        'type="cylinder"',
        'type="mesh" mesh="m"',
    ]

    def numbers(low, high, count=3):
        return " ".join(f"{value:.3f}" for value in rng.uniform(low, high, count))

    geoms = "".join(
        f'<geom {kind} size="{numbers(0.05, 0.3)}" pos="{numbers(-2, 2)}" euler="{numbers(-180, 180)}" '
        f'rgba="{numbers(0, 1)} 1"/>'
        for kind in kinds * 6
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="m" vertex="0 0 0 .4 0 0 0 .5 0 .1 .2 .3"/></asset><worldbody>'
        f'<camera name="eye" euler="{numbers(-180, 180)}" {options}/><light pos="0 0 3" castshadow="true"/>{geoms}'
        '<geom type="plane" size="5 5 1" pos="0 0 -1.5"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


LENS = 'sensorsize=".02 .015" focal=".012 .014" principal=".004 -.003" resolution="60 48"'


@pytest.mark.parametrize("options", ['fovy="50"', LENS])
def test_pictures_are_those_with_everything_drawn(everything, options):
    """And segmentation and depth where a wanted geom is seen; without wanted ones everywhere."""
    scenes = [random_scene(seed, options) for seed in range(12)]
    wanted = [[3], [5, 11], [0], [17]] * 3

    def look():
        frames = []
        for (model, data), ids in zip(scenes, wanted, strict=True):
            camera = Camera(model, "eye", height=48, width=60, mask_scale=2)
            frames.append((camera.render(data, depth=True), camera.render(data, depth=True, wanted=ids)))
            camera.close()
        return frames

    drawn = look()
    everything()
    seen = 0
    for (some, few), (all_of_it, _), ids in zip(drawn, look(), wanted, strict=True):
        for part, whole in zip(some, all_of_it, strict=True):
            assert np.array_equal(part, whole)
        assert np.array_equal(few.pixels, all_of_it.pixels)
        there = np.isin(all_of_it.geoms, ids)
        assert np.array_equal(np.isin(few.geoms, ids), there)
        assert np.array_equal(few.depth[there], all_of_it.depth[there])
        seen += there.sum()
    assert seen > 500  # or nothing was compared


def test_geoms_that_are_culled_are_not_drawn():
    """They are missing from a search for another one; and the model's groups are as they were."""
    mesh = '<mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset>{mesh}</asset><worldbody><camera name="eye" pos="0 0 1" fovy="90"/>{BALL}'
        '<geom type="mesh" mesh="m" pos=".5 0 0" group="2"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = Camera(model, "eye")
    assert np.unique(camera.render(data).geoms).tolist() == [-1, 0, 1]
    assert np.unique(camera.render(data, wanted=[0]).geoms).tolist() == [-1, 0]
    assert model.geom_group.tolist() == [0, 2]
    camera.close()


def test_the_groups_are_as_they_were_after_an_interrupt(monkeypatch):
    model, data = random_scene(2)
    groups, during = model.geom_group.copy(), []

    def interrupt(model, *_):
        during.append(model.geom_group.copy())
        raise KeyboardInterrupt

    monkeypatch.setattr(camera_module.mujoco, "mjv_updateScene", interrupt)
    camera = Camera(model, "eye")
    with pytest.raises(KeyboardInterrupt):
        camera.render(data)
    assert not np.array_equal(during[0], groups)
    assert np.array_equal(model.geom_group, groups)
    camera.close()


@pytest.mark.parametrize("effect", ["shadows", "reflections"])
def test_what_is_not_seen_may_cast_a_shadow_or_a_reflection(monkeypatch, effect):
    def refuse(*_, **__):
        raise AssertionError("culled")

    model, data = random_scene(0)
    monkeypatch.setattr(camera_module, "culled_geoms", refuse)
    camera = Camera(model, "eye", **{effect: True})
    camera.render(data, wanted=[0])
    camera.close()
    without = Camera(model, "eye")
    with pytest.raises(AssertionError, match="culled"):
        without.render(data)
    without.close()


@pytest.mark.parametrize("make", [Reacher, CubeMove, ShelfPlace, PickPlace])
def test_observations_are_those_with_everything_drawn(everything, make):
    def episode():
        env = (
            make(image_size=32, privileged=True, objects=("cube", "distractor"))
            if make is CubeMove
            else make(image_size=32)
        )
        seen = [env.reset(seed=3)[0]]
        for step in range(8):
            action = env.scripted_action() if step < 5 else np.full(env.action_space.shape, -1.0)
            seen.append(env.step(action)[0])
        seen.append(env.goal_observation(env.workspace.landmarks[0]))
        env.close()
        return seen

    drawn = episode()
    everything()
    for some, whole in zip(drawn, episode(), strict=True):
        assert_same(some, whole)


@pytest.mark.parametrize(("labelled_frames", "searches"), [(0, True), (2, False)])
def test_environments_look_for_their_objects(monkeypatch, labelled_frames, searches):
    """Colours are found anywhere, and their depth with them."""
    env = PickPlace(image_size=32, labelled_frames=labelled_frames)
    render, wanted = env.camera.render, []

    def spy(*arguments, **options):
        wanted.append(options["wanted"])
        return render(*arguments, **options)

    monkeypatch.setattr(env.camera, "render", spy)
    env.reset(seed=0)
    ids = [env.model.geom(name).id for names in env.objects.values() for name in names]
    assert wanted == [ids if searches else None]
    env.close()
