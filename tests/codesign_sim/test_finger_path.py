"""The fingers' path between two targets, as the kernels compute it."""

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from codesign_sim import FingerTargets, kernels
from codesign_sim.fingers import motion

wp.set_module_options(kernels._options())


@wp.func_native("""
    codesign::Rigid<float> fingers[2];
    codesign::place_fingers<codesign::TEAM>(motion.data, fraction, fingers);
    for (int side = 0; side < 2; ++side) {
        for (int k = 0; k < 9; ++k)
            poses.data[12 * side + k] = fingers[side].r[k];
        poses.data[12 * side + 9] = fingers[side].t.x;
        poses.data[12 * side + 10] = fingers[side].t.y;
        poses.data[12 * side + 11] = fingers[side].t.z;
    }
""")
def _place(motion: wp.array[wp.float32], fraction: float, poses: wp.array[wp.float32]): ...


@wp.kernel
def _place_kernel(motion: wp.array[wp.float32], fraction: float, poses: wp.array[wp.float32]):
    _place(motion, fraction, poses)


def placed(start: FingerTargets, end: FingerTargets, fraction: float):
    """Rotations (2, 3, 3) and translations (2, 3) of the left and the right finger."""
    values = wp.array(motion(start, end)[0], dtype=wp.float32, device="cpu")
    poses = wp.zeros(24, dtype=wp.float32, device="cpu")
    wp.launch(_place_kernel, 1, inputs=[values, fraction, poses], device="cpu")
    found = poses.numpy().reshape(2, 12).astype(float)
    return found[:, :9].reshape(2, 3, 3), found[:, 9:]


def test_width_shifts_the_fingers_apart_along_their_opening():
    target = FingerTargets(np.array([1.0, 2.0, 3.0]), np.array([0, 0, 0, 1.0]), 0.04)
    _, places = placed(target, target, 0.0)
    np.testing.assert_allclose(places, [[1.0, 2.02, 3.0], [1.0, 1.98, 3.0]], rtol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-5, 1e-3, 0.1, 3.0]), st.floats(0, 1.02))
def test_fingers_move_and_turn_at_constant_speed(seed, angle, fraction):
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    first = Rotation.random(random_state=rng)
    last = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * first
    way, widths = rng.uniform(-1, 1, (2, 3)), rng.uniform(0, 0.05, 2)
    start = FingerTargets(way[0], first.as_quat(), widths[0])
    end = FingerTargets(way[1], -last.as_quat(), widths[1])  # the same rotation
    rotations, places = placed(start, end, fraction)
    turned = Rotation.from_rotvec(fraction * (last * first.inv()).as_rotvec()) * first
    np.testing.assert_allclose(rotations, np.stack([turned.as_matrix()] * 2), atol=2e-6)
    middle = way[0] + fraction * (way[1] - way[0])
    opening = turned.as_matrix()[:, 1] * (widths[0] + fraction * (widths[1] - widths[0])) / 2
    np.testing.assert_allclose(places, [middle + opening, middle - opening], atol=1e-6)
