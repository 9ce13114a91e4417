"""Many environments give what each would alone."""

import numpy as np
import pytest
from small_block import SMALL

from codesign_sim import FingerTargets, Material, Simulator, SurfaceMesh

COUNT = 9  # two groups of eight lanes, one of them nearly empty


def trial(simulator, materials, places, widths, yaws):
    count = len(materials)

    def targets(height, width):
        position = np.column_stack([places, np.full(count, height)])
        turn = FingerTargets.from_above
        rows = [turn(p, w, y) for p, w, y in zip(position, width, yaws, strict=True)]
        return FingerTargets(
            position,
            np.concatenate([r.quaternion for r in rows]),
            np.concatenate([r.width for r in rows]),
        )

    simulator.reset(materials, places, yaws, targets(0.026, np.full(count, 0.034)))
    simulator.advance(0.15, targets(0.026, widths))
    simulator.advance(0.15, targets(0.036, widths))
    return simulator


@pytest.fixture(scope="module")
def draws():
    rng = np.random.default_rng(11)
    materials = [
        Material(rng.uniform(8e3, 10e3), rng.uniform(0.3, 0.34), 1020, rng.uniform(0.5, 0.9))
        for _ in range(COUNT)
    ]
    places = rng.uniform(-0.2, 0.2, (COUNT, 2))
    return materials, places, rng.uniform(0.024, 0.027, COUNT), rng.uniform(-0.5, 0.5, COUNT)


@pytest.fixture(scope="module")
def fingers():
    pads = []
    for k in range(COUNT):
        half = 0.008 + 0.0005 * k
        left = SurfaceMesh.box((-half, 0.0, -0.025), (half, 0.01, 0.025))
        right = SurfaceMesh.box((-half, -0.01, -0.025), (half, 0.0, 0.025))
        pads.append((left, right))
    return pads


@pytest.fixture(scope="module")
def together(draws, fingers):
    return trial(Simulator(SMALL, fingers, COUNT, time_step=5e-4), *draws)


@pytest.mark.parametrize("k", [0, 5, 8])
def test_each_environment_equals_its_single_run(draws, fingers, together, k):
    alone = Simulator(SMALL, fingers[k], time_step=5e-4)
    trial(alone, [draws[0][k]], draws[1][k : k + 1], draws[2][k : k + 1], draws[3][k : k + 1])
    assert np.allclose(together.positions[k], alone.positions[0], atol=2e-6)
    assert together.stress().top10_mean[k] == pytest.approx(alone.stress().top10_mean[0], rel=2e-3)
    assert np.allclose(together.stress().von_mises[k], alone.stress().von_mises[0], atol=5)
    for name in ("left", "right", "table"):
        both = getattr(together.contact(), name)[k], getattr(alone.contact(), name)[0]
        assert np.allclose(*both, atol=5e-3)
    assert np.allclose(together.object_pose()[0][k], alone.object_pose()[0][0], atol=2e-6)


def test_environments_differ(together):
    top = together.stress().top10_mean
    assert len(np.unique(top.round(1))) == COUNT


def test_two_environments_in_one_lane_each(draws, fingers):
    few = [d[:2] for d in draws]
    pair = trial(Simulator(SMALL, fingers[:2], 2, time_step=5e-4), *few)
    single = Simulator(SMALL, fingers[1], time_step=5e-4)
    trial(single, draws[0][1:2], draws[1][1:2], draws[2][1:2], draws[3][1:2])
    assert np.array_equal(pair.positions[1], single.positions[0])


def test_batches_repeat_bit_for_bit(draws, fingers, together):
    again = trial(Simulator(SMALL, fingers, COUNT, time_step=5e-4), *draws)
    assert np.array_equal(again.positions, together.positions)
