"""The rendered camera: things appear where the camera's model says, and repeat by their seeds."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_trial import SyntheticTrial

from codesign_perception.camera import Camera
from codesign_report.rendered_camera import (
    CAMERA_LOOK,
    REALISTIC,
    Effects,
    RenderedCamera,
    SceneState,
    board_prop,
    spoil,
)
from codesign_report.scene import Prop

TRIAL = SyntheticTrial()
DISTORTION = [-0.1, 0.05, 0.001, -0.002, 0.01]
SIZE = (640, 360)
BOX = np.array([0.025, 0.015, 0.02])  # half lengths [m]
PLACE = np.array([0.45, 0.0, 0.02])


def camera(distortion=None, size=SIZE):
    """Off its middle in every respect: principal point, focal lengths, roll."""
    base = Camera.looking_at(
        [0.80, 0.10, 0.27], [0.45, 0.0, 0.04], width=size[0], height=size[1], focal=0.8 * size[0]
    )
    matrix = base.matrix.copy()
    matrix[0, 2] += 0.018 * size[0]
    matrix[1, 2] -= 0.011 * size[0]
    matrix[1, 1] *= 1.02
    roll = (Rotation.from_quat(base.quaternion) * Rotation.from_euler("z", 0.1)).as_quat()
    lens = np.zeros(5) if distortion is None else np.asarray(distortion)
    return Camera(*size, matrix, lens, base.position, roll)


@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_corners_of_a_board_appear_where_the_camera_projects_them(distortion):
    """Found by OpenCV's ChArUco detector, good to 0.05 px; oblique corners to 0.2 px."""
    board = cv2.aruco.CharucoBoard(
        (7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    rotation = Rotation.from_euler("zyx", [2.0, 0.3, 0.2]).as_matrix()
    place = np.array([0.45, 0.0, 0.06])
    seen = camera(distortion, (1280, 720))
    prop = board_prop(board.generateImage((840, 600)), (0.21, 0.15), place, rotation)
    with RenderedCamera(seen, props=[prop]) as rendered:
        grey = cv2.cvtColor(rendered.capture(), cv2.COLOR_RGB2GRAY)
    found, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    assert len(ids) == 24
    corners = board.getChessboardCorners()[ids.ravel()].astype(float)
    local = (corners - [0.105, 0.075, 0.0]) * [1.0, -1.0, 1.0]  # OpenCV's board has y downwards
    off = found.reshape(-1, 2) - seen.project(local @ rotation.T + place)
    assert np.abs(off.mean(axis=0)).max() < 0.03
    assert np.sqrt((off**2).mean()) < 0.08
    assert np.abs(off).max() < 0.2


def edge_offset(picture, seen, start, end, middle):
    """How far a straight edge of a body lies outward of where it is projected, mean [px].

    Taken from the share of the body's brightness that each pixel across the edge has.
    """
    a, b, c = seen.project([start, end, middle])
    along = (b - a) / np.linalg.norm(b - a)
    normal = np.array([-along[1], along[0]])
    normal *= np.sign(normal @ (a - c))
    step = np.arange(-6.0, 6.01, 0.1)
    offsets = []
    for share in np.linspace(0.2, 0.8, 25):
        places = a + (b - a) * share + np.outer(step, normal)
        profile = cv2.remap(
            picture[..., 2].astype(np.float32),
            places[:, 0].astype(np.float32)[None],
            places[:, 1].astype(np.float32)[None],
            cv2.INTER_LINEAR,
        )[0]
        inside, outside = profile[:20].mean(), profile[-20:].mean()
        offsets.append(((profile - outside) / (inside - outside)).sum() * 0.1 - 6.05)
    return float(np.mean(offsets))


@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_a_box_ends_where_it_is_projected(distortion):
    seen = camera(distortion, (1280, 720))
    box = Prop("box", tuple(BOX), (0.97, 0.95, 0.9, 1.0), position=PLACE)
    with RenderedCamera(seen, props=[box]) as rendered:
        picture = rendered.ideal()

    def corner(*signs):
        return PLACE + BOX * signs

    edges = {
        "front, bottom": (corner(1, -1, -1), corner(1, 1, -1)),
        "front, upright": (corner(1, -1, -1), corner(1, -1, 1)),
        "rear, top": (corner(-1, -1, 1), corner(-1, 1, 1)),
    }
    for name, (start, end) in edges.items():
        assert abs(edge_offset(picture, seen, start, end, PLACE)) < 0.1, name


@pytest.fixture(scope="module")
def grasp():
    """The soft body between its fingers, noisy, cluttered and off its calibration."""
    effects = Effects(noise=4.0, defocus=0.6, motion=2.0, light=0.2, clutter=6, seed=5)
    middle = TRIAL.positions(0.0).mean(axis=0)
    seen = Camera.looking_at(
        middle + np.array([0.4, 0.1, 0.28]),
        middle,
        width=SIZE[0],
        height=SIZE[1],
    )
    with RenderedCamera(seen, TRIAL.body, TRIAL.fingers, effects=effects) as rendered:
        yield rendered


def at(t):
    return SceneState(TRIAL.positions(t), TRIAL.pose(t, 1), TRIAL.pose(t, -1))


def test_pictures_repeat_by_seed_and_number(grasp):
    first = grasp.capture(at(2.0), frame=3)
    assert first.shape == (SIZE[1], SIZE[0], 3)
    assert first.dtype == np.uint8
    other = grasp.capture(at(2.0), frame=4)
    np.testing.assert_array_equal(grasp.capture(at(2.0), frame=3), first)
    assert (other != first).mean() > 0.5


def test_the_tofu_is_pale_and_the_table_is_not(grasp):
    picture = grasp.ideal(at(0.0)).astype(float)
    u, v = np.round(grasp.camera.project(TRIAL.positions(0.0).mean(axis=0)[None])[0]).astype(int)
    tofu = picture[v - 5 : v + 6, u - 5 : u + 6].reshape(-1, 3).mean(axis=0)
    table = np.median(picture[-40:].reshape(-1, 3), axis=0)
    assert tofu.min() > 120
    assert np.ptp(tofu) < 40
    assert np.ptp(table) > 40


def test_the_deformed_body_covers_its_projection(grasp):
    """At rest, and squeezed and lifted: what is pale is the hull of the projected nodes."""
    with RenderedCamera(grasp.camera, TRIAL.body) as rendered:
        for t in (0.0, 2.6):
            nodes = TRIAL.positions(t)
            pale = rendered.ideal(SceneState(nodes)).min(axis=2) > 115
            hull = cv2.convexHull(grasp.camera.project(nodes).astype(np.float32))
            expected = np.zeros(pale.shape, dtype=np.uint8)
            cv2.fillConvexPoly(expected, np.round(hull).astype(np.int32), 1)
            both, either = (pale & (expected > 0)).sum(), (pale | (expected > 0)).sum()
            assert expected.sum() > 1000
            assert both > 0.9 * either


def test_clutter_is_laid_out_by_its_seed_and_not_before_the_object(grasp):
    def layout(seed):
        grasp.scatter_clutter(seed)
        return np.array([thing.position for thing in grasp._clutter])

    first = layout(1)
    np.testing.assert_array_equal(layout(1), first)
    assert (layout(2) != first).any()
    toward = grasp.camera.position[:2] - [0.45, 0.0]
    for seed in range(20):
        away = layout(seed)[:, :2] - [0.45, 0.0]
        distance = np.linalg.norm(away, axis=1)
        assert distance.min() >= 0.075
        cosine = away @ toward / distance / np.linalg.norm(toward)
        assert cosine.max() <= np.cos(np.radians(39.9))


def test_noise_and_light_have_the_size_that_was_asked_for():
    grey = np.full((400, 400, 3), 128, dtype=np.uint8)
    noisy = spoil(grey, Effects(noise=8.0)).astype(float)
    assert noisy.std() == pytest.approx(8.0 * np.sqrt(0.4 + 0.6 * 128 / 255), rel=0.03)
    assert noisy.mean() == pytest.approx(128.0, abs=0.1)
    means = [spoil(grey, Effects(light=0.2, seed=2), k).mean() / 128 for k in range(200)]
    assert 0.795 <= min(means) < 0.83
    assert 1.17 < max(means) <= 1.205


def test_blur_keeps_the_mean_and_has_its_width():
    line = np.zeros((101, 101, 3), dtype=np.uint8)
    line[:, 50] = 200
    for effects, expected in ((Effects(defocus=2.0), 2.0), (Effects(motion=8.0), None)):
        profile = spoil(line, effects)[50, :, 0].astype(float)
        assert profile.sum() == pytest.approx(200.0, rel=0.03)
        if expected:
            x = np.arange(101)
            spread = np.sqrt((profile * (x - 50.0) ** 2).sum() / profile.sum())
            assert spread == pytest.approx(expected, rel=0.06)


def test_a_wrong_calibration_is_off_by_exactly_what_was_asked_for():
    seen = camera()
    effects = Effects(rotation_error=np.radians(0.2), translation_error=1e-3, seed=3)
    with RenderedCamera(seen, effects=effects) as rendered:
        true = rendered.true_camera
        turn = Rotation.from_quat(true.quaternion) * Rotation.from_quat(seen.quaternion).inv()
        assert turn.magnitude() == pytest.approx(np.radians(0.2), rel=1e-6)
        assert np.linalg.norm(true.position - seen.position) == pytest.approx(1e-3, rel=1e-6)
        assert rendered.camera is seen
    with RenderedCamera(seen, effects=replace(effects, seed=4)) as other:
        assert not np.allclose(other.true_camera.position, true.position, atol=1e-6)


def test_a_moved_camera_sees_as_one_made_there():
    there = camera().moved([0.7, -0.2, 0.3], camera().quaternion)
    box = Prop("box", tuple(BOX), position=PLACE)
    with RenderedCamera(camera(), props=[box]) as moved, RenderedCamera(there, props=[box]) as made:
        moved.camera = there
        np.testing.assert_array_equal(moved.ideal(), made.ideal())
        with pytest.raises(ValueError, match="another lens"):
            moved.camera = camera(DISTORTION)


def test_hidden_props_leave_the_picture_as_it_was():
    box = Prop("sphere", (0.02,), position=PLACE)
    with RenderedCamera(camera(), props=[box]) as rendered, RenderedCamera(camera()) as empty:
        assert (rendered.ideal() != empty.ideal()).any()
        box.visible = False
        np.testing.assert_array_equal(rendered.ideal(), empty.ideal())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Effects(noise=-1.0), "noise is -1.0"),
        (lambda: Effects(clutter=1000), "clutter is 1000"),
        (lambda: Effects(light=float("nan")), "light is nan"),
        (lambda: RenderedCamera(camera([-1.5, 0, 0, 0, 0])), "distortion"),
        (lambda: RenderedCamera(camera(), props=[Prop("cone", (0.1,))]), "'cone'"),
        (lambda: RenderedCamera(camera(), props=[Prop("box", (0.1,))]), "3 positive lengths"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_realistic_preset_leaves_the_ideal_picture_recognisable():
    with RenderedCamera(
        camera(),
        props=[Prop("box", tuple(BOX), position=PLACE)],
        effects=REALISTIC,
        look=replace(CAMERA_LOOK, samples=0),
    ) as rendered:
        difference = rendered.capture(frame=1).astype(float) - rendered.ideal()
    assert 1.0 < np.abs(difference).mean() < 20.0
