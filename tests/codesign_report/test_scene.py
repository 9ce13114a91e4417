"""The renderer: colours are the map's, things are where they should be."""

import ctypes.util

import numpy as np
import pytest
from synthetic_trial import CENTER, DOMAIN, SIZE, SyntheticTrial

from codesign_report import scene
from codesign_report.recording import TriangleMesh
from codesign_report.scene import Camera, SceneRenderer, stress_color

RANGE = (0.0, 5000.0)
AWAY = 1.0  # s: fingers open
TRIAL = SyntheticTrial()
FAR_FINGERS = ([0, 0, 3.0, 0, 0, 0, 1.0], [0, 0, 3.0, 0, 0, 0, 1.0])


@pytest.fixture(scope="module")
def renderer():
    size = {"width": 320, "height": 240}
    with SceneRenderer(
        TRIAL.body, TRIAL.fingers, **size, stress_range=RANGE, center=tuple(CENTER)
    ) as made:
        made.camera = front()
        yield made


def front(distance=0.4):
    """At the block's wide side, level with it."""
    yaw = DOMAIN["yaw"]
    target = np.array([*CENTER, SIZE[2] / 2])
    return Camera.look_at(target + distance * np.array([np.cos(yaw), np.sin(yaw), 0.15]), target)


def draw(renderer, von_mises, t=0.0, fingers=FAR_FINGERS):
    return renderer.render(TRIAL.positions(t), von_mises, *fingers)


def uniform(value):
    return np.full(len(TRIAL.body.tetrahedra), float(value))


@pytest.mark.parametrize("value", [0.0, 1500.0, 2600.0, 4000.0, 9000.0])
def test_a_stress_has_its_colour(renderer, value):
    seen = draw(renderer, uniform(value))[110:130, 150:170].reshape(-1, 3).astype(float)
    expected = np.array(stress_color(value, RANGE), dtype=float)
    assert np.ptp(seen, axis=0).max() <= 6
    # Shading may darken a face a little, all channels alike; it never changes the hue.
    ratio = seen.mean(axis=0)[expected > 25] / expected[expected > 25]
    assert ratio.min() >= 0.82
    assert ratio.max() <= 1.02
    assert np.ptp(ratio) < 0.05


def test_stress_appears_where_it_is(renderer):
    middle = TRIAL.body.rest_positions[TRIAL.body.tetrahedra].mean(axis=1)
    picture = draw(renderer, np.where(middle[:, 1] > 0.0, 4500.0, 0.0)).astype(float)
    hot = np.abs(picture - stress_color(4500.0, RANGE)).sum(axis=2) < 60
    cold = np.abs(picture - stress_color(0.0, RANGE)).sum(axis=2) < 90
    rows = slice(100, 140)
    # +y of the block is to the right of a camera that looks along its -x.
    assert hot[rows, 170:185].mean() > 0.9
    assert cold[rows, 130:150].mean() > 0.9


def test_the_object_is_drawn_where_it_is(renderer):
    picture = draw(renderer, uniform(4500.0)).astype(float)
    block = np.abs(picture - stress_color(4500.0, RANGE)).sum(axis=2) < 60
    rows, columns = np.nonzero(block)
    assert abs(columns.mean() - 160) < 3
    assert abs(rows.mean() - 120) < 8
    pixel = 0.4 * np.sqrt(1.0225) * 2 * np.tan(renderer.camera.fovy / 2) / 240  # m
    assert np.ptp(columns) * pixel == pytest.approx(SIZE[1], rel=0.1)


def test_a_lifted_object_is_higher_in_the_picture(renderer):
    tops = []
    for t in (0.0, 2.6):
        picture = draw(renderer, uniform(4500.0), t).astype(float)
        block = np.abs(picture - stress_color(4500.0, RANGE)).sum(axis=2) < 60
        tops.append(np.nonzero(block)[0].mean())
    assert tops[1] < tops[0] - 20


def test_the_picture_is_not_empty(renderer):
    picture = draw(
        renderer, TRIAL.von_mises(AWAY), AWAY, (TRIAL.pose(AWAY, 1), TRIAL.pose(AWAY, -1))
    )
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500
    assert picture.std() > 10


def test_fingers_appear(renderer):
    poses = TRIAL.pose(AWAY, 1), TRIAL.pose(AWAY, -1)
    changed = draw(renderer, uniform(0.0), fingers=poses) != draw(renderer, uniform(0.0))
    columns = np.nonzero(changed.any(axis=(0, 2)))[0]
    assert columns.min() < 120
    assert columns.max() > 200


def test_without_stress_it_looks_like_tofu(renderer):
    r, g, b = draw(renderer, None)[110:130, 150:170].reshape(-1, 3).mean(axis=0)
    assert r >= g >= b > 120
    assert stress_color(0.0, RANGE) != (round(r), round(g), round(b))


def test_pictures_repeat(renderer):
    first = draw(renderer, TRIAL.von_mises(2.0), 2.0)
    draw(renderer, uniform(1000.0), 0.5)
    np.testing.assert_array_equal(draw(renderer, TRIAL.von_mises(2.0), 2.0), first)


def test_the_principal_point_moves_the_picture(renderer):
    def middle():
        picture = draw(renderer, uniform(4500.0)).astype(float)
        block = np.abs(picture - stress_color(4500.0, RANGE)).sum(axis=2) < 60
        return np.mean(np.nonzero(block), axis=1)

    before = middle()
    base = front()
    renderer.camera = Camera(base.position, base.forward, shift=(0.1, 0.05))
    after = middle()
    renderer.camera = base
    np.testing.assert_allclose(after - before, [-0.05 * 240, 0.1 * 240], atol=1.5)


def test_two_renderers_side_by_side(renderer):
    expected = draw(renderer, uniform(2600.0))
    other = SceneRenderer(TRIAL.body, TRIAL.fingers, 64, 48, center=tuple(CENTER))
    assert draw(other, None).shape == (48, 64, 3)
    np.testing.assert_array_equal(draw(renderer, uniform(2600.0)), expected)
    other.close()
    np.testing.assert_array_equal(draw(renderer, uniform(2600.0)), expected)


def test_closed():
    renderer = SceneRenderer(TRIAL.body, TRIAL.fingers, 64, 48)
    renderer.close()
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        draw(renderer, None)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"width": 8}, "8 x 720 px"),
        ({"stress_range": (5.0, 5.0)}, "stress_range"),
        ({"stress_range": (0.0, np.nan)}, "stress_range"),
        ({"stress_range": (0.0, np.inf)}, "stress_range"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        SceneRenderer(TRIAL.body, TRIAL.fingers, **kwargs)


def test_two_fingers_are_needed():
    with pytest.raises(ValueError, match="1 meshes"):
        SceneRenderer(TRIAL.body, TRIAL.fingers[:1])


def test_without_opengl_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    scene._gl_context_class.cache_clear()
    with pytest.raises(RuntimeError, match=r"apt-get install libegl1"):
        SceneRenderer(TRIAL.body, TRIAL.fingers, 64, 48)
    scene._gl_context_class.cache_clear()


def test_creases_stay_sharp_and_round_parts_smooth():
    cube, _ = TRIAL.fingers
    soup = scene._Soup(cube)
    assert np.isclose(np.abs(soup.normals).max(axis=1), 1.0).all()

    angles = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    tube = np.concatenate([np.column_stack([ring, np.full(32, z)]) for z in (0.0, 1.0)])
    i = np.arange(32)
    j = (i + 1) % 32
    faces = np.concatenate([np.column_stack([i, j, j + 32]), np.column_stack([i, j + 32, i + 32])])
    soup = scene._Soup(TriangleMesh(tube, faces))
    radial = soup.corners * [1.0, 1.0, 0.0]
    assert (np.einsum("ij,ij->i", soup.normals, radial) > 0.995).all()
