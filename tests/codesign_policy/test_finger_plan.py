"""The grasp planned from a finger's shape, and how it goes in the simulator."""

import numpy as np
import pytest
import trimesh

from codesign_design.experts import expert, expert_names, flat_pad, scoop
from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.stock import stock_fingers
from codesign_policy.domain import BLOCK_SIZE, TrialDomain, draw_domain
from codesign_policy.finger_plan import front_view, plan_for
from codesign_policy.grasp_trials import run_grasps
from codesign_policy.simulated_fingers import SOLE, simulated_fingers
from codesign_sim import Block


def pair(left: TriangleMesh, min_width: float = 0.0, max_width: float = 0.06) -> FingerPair:
    return FingerPair("mine", left, left.mirrored_y(), min_width, max_width)


def test_front_view_measures_pad_and_lip() -> None:
    view = front_view(scoop(lip=0.010, chamfer=0.006))
    assert view.pad == pytest.approx(0.010, abs=1e-6)
    assert view.lip == pytest.approx(0.010, abs=1e-6)
    flat = front_view(flat_pad())
    assert flat.lip == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(flat.depth, 0.0, atol=1e-6)  # larger than the block's side


def test_narrow_pads_leave_part_of_the_block_uncovered() -> None:
    depth = front_view(flat_pad(width=0.025, height=0.045)).depth
    assert np.isfinite(depth).mean() == pytest.approx(0.5, abs=0.01)


def test_flat_pads_squeeze_as_a_linear_spring_says() -> None:
    """Over the whole 50 x 40 mm side: squeeze = 1.4 m g / (2 mu) / (E A / d), rounded up."""
    squeeze = 1.4 * (1020 * 6e-5 * 9.81) / (2 * 0.5) / (9000 * 0.05 * 0.04 / 0.03)
    assert 0.0 <= (0.030 - squeeze) - plan_for(pair(flat_pad())).width < 1e-4
    # Half the area takes twice the squeeze; the fillets take a little of the half.
    half = 0.030 - plan_for(pair(flat_pad(width=0.025))).width
    assert half == pytest.approx(2 * squeeze, rel=0.05)


def test_stock_fingers_close_as_they_always_did() -> None:
    plan = plan_for(stock_fingers())
    assert (plan.width, plan.open_width, plan.clearance) == (0.0273, 0.046, 0.0015)


def test_lips_come_down_beside_the_block_and_stop_when_the_pads_touch() -> None:
    plan = plan_for(pair(scoop(lip=0.010, chamfer=0.006)))
    assert plan.width == pytest.approx(0.030 - 0.0001 - 2 * 0.010)
    assert plan.open_width >= 0.030 + 0.008
    assert plan.clearance < 0.0003


@pytest.mark.parametrize(
    ("fingers", "said"),
    [
        (pair(flat_pad(), max_width=0.035), r"open to 0\.035 m, the block needs 0\.038 m"),
        (pair(scoop(), min_width=0.008), r"close to 0\.008 m, the grasp needs 0\.0059 m"),
        (
            pair(TriangleMesh(flat_pad().vertices + np.array([0.1, 0, 0]), flat_pad().faces)),
            "no pad between",
        ),
    ],
)
def test_fingers_that_cannot_grasp_the_block_are_refused(fingers: FingerPair, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        plan_for(fingers)


def test_only_lips_get_a_sole() -> None:
    pads, lips = stock_fingers(), pair(scoop())
    for fingers, thicker in ((pads, 0.0), (lips, SOLE)):
        left, right = simulated_fingers(fingers)
        lowest = left.vertices[:, 2].max() - fingers.left.vertices[:, 2].max()
        assert lowest == pytest.approx(thicker, abs=1e-6)
        volumes = [
            trimesh.Trimesh(m.vertices, m.faces, process=False).volume for m in (left, right)
        ]
        assert volumes[1] == pytest.approx(volumes[0], rel=1e-6)
        assert right.vertices[:, 1].min() == pytest.approx(-left.vertices[:, 1].max(), abs=1e-9)


@pytest.mark.parametrize("name", expert_names())
def test_experts_pick_tofu_up(name: str) -> None:
    """600 tetrahedra, places drawn within 4 mm; stresses in the docs are at 2,400."""
    fingers = expert(name)
    domains = [draw_domain(seed) for seed in range(2)]
    trials = run_grasps(fingers, [plan_for(fingers)] * 2, domains, tetrahedra=600)
    for trial, domain in zip(trials, domains, strict=True):
        assert trial.metrics.success
        weight = domain.density * Block().volume * 9.81
        assert trial.metrics.held_force == pytest.approx(weight, rel=0.02)
        assert trial.peak_top10 >= trial.held_top10 >= trial.held_median > 0.0


def test_lips_get_under_the_block_and_carry_it() -> None:
    """A block on lips is up by their thickness, and needs next to no squeeze."""
    fingers = expert("scoop")
    domains = [draw_domain(seed, TrialDomain(friction=mu)) for mu, seed in ((0.4, 1), (0.5, 2))]
    for trial in run_grasps(fingers, [plan_for(fingers)] * 2, domains, tetrahedra=600):
        assert trial.metrics.success
        assert trial.metrics.peak_lift == pytest.approx(0.1 + 0.0015, abs=0.0007)


def test_the_block_is_the_simulators() -> None:
    assert Block().size == BLOCK_SIZE


def test_plans_and_domains_come_in_pairs() -> None:
    fingers = stock_fingers()
    with pytest.raises(ValueError, match="2 plans for 1 domains"):
        run_grasps(fingers, [plan_for(fingers)] * 2, [draw_domain(0)], 600)
