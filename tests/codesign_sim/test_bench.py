"""The bench measures what it says, on a real grasp."""

import numpy as np
import pytest

from codesign_sim import Block, SurfaceMesh
from codesign_sim.bench import Case, cases, describe_machine, full_lanes, ratios, run
from codesign_sim.bench.cases import Pass, Rate, Result
from codesign_sim.bench.codesign_solver import CodesignGrasp
from codesign_sim.bench.mujoco_solver import MujocoGrasp
from codesign_sim.bench.scenario import CLOSE, CLOSED, LIFT, OPEN, RISE, STEPS, pose
from codesign_sim.bench.workers import together


def test_the_scenario_closes_then_lifts_then_holds(pads):
    assert pose(pads, 0).width == OPEN
    assert pose(pads, CLOSE).width == pytest.approx(CLOSED)
    assert pose(pads, CLOSE).height == pytest.approx(pose(pads, 0).height)
    assert pose(pads, CLOSE + LIFT / 2).height - pose(pads, 0).height == pytest.approx(RISE / 2)
    assert pose(pads, STEPS) == pose(pads, CLOSE + LIFT)


def test_fingers_of_any_height_meet_the_block_in_the_middle():
    low = SurfaceMesh.box((-0.01, 0.0, -0.040), (0.01, 0.01, -0.010))
    assert pose((low, low), 0).height - pose((low, low), STEPS).height == pytest.approx(-RISE)
    assert pose((low, low), 0).height == pytest.approx(0.026 - 0.025)


def test_a_pass_is_a_grasp_that_holds(pads):
    grasp = CodesignGrasp(Case("codesign", 600, 2, 1), pads)
    measured = grasp.run()
    assert measured.control_steps == 2 * STEPS
    assert measured.rise == pytest.approx((RISE, RISE), abs=0.003)
    assert measured.cpu > 0
    assert 0 < measured.time_step < 1e-3


def test_mujoco_has_the_same_block_and_pads(pads):
    grasp = MujocoGrasp(Case("mujoco-flex", 600, 1, 1), pads)
    model, block = grasp._model, Block.tofu(600)
    assert model.nflexelem == block.resolution
    assert model.body_mass[3:].sum() == pytest.approx(1020 * block.volume, rel=1e-6)
    assert model.geom_size[1] == pytest.approx([0.01, 0.005, 0.025])
    assert np.isin(model.geom_friction[:, 0], 0.5).all()
    data = grasp._data[0]
    extent = np.ptp(data.flexvert_xpos, axis=0)
    assert extent == pytest.approx(block.size, rel=0.01)


def test_mujoco_pads_go_where_they_are_told(pads):
    import mujoco

    grasp = MujocoGrasp(Case("mujoco-flex", 600, 1, 1), pads)
    data = grasp._data[0]
    mujoco.mj_resetData(grasp._model, data)
    data.qpos[:4] = grasp._pads(0)
    for step in (0.125, 0.25):
        grasp._place(data, step)
        mujoco.mj_step(grasp._model, data)
        assert data.qpos[:4] == pytest.approx(grasp._pads(step), abs=1e-6)


def test_processes_run_side_by_side_and_add_up(pads):
    cases = [Case("codesign", 600, 1, 1), Case("codesign", 600, 1, 2)]
    one, two = run(cases, pads, seconds=0.1)
    for result in (one, two):
        assert result.held
        assert result.lifted
        assert result.wall.least <= result.wall.median <= result.wall.greatest
        assert 5e3 < result.bytes_per_environment < 5e6
    assert set(one.as_dict()) >= {
        "solver", "tets", "envs", "processes", "control_steps_per_second",
        "control_steps_per_cpu_second",
    }  # fmt: skip


def test_an_error_in_a_process_is_raised_here(pads):
    with pytest.raises(ValueError, match="no tofu mesh of 7 tetrahedra"):
        run([Case("codesign", 7, 1, 1)], pads, seconds=0.1)


def test_passes_add_up():
    one = Pass(10, 1.0, 0.5, 1e-3, (0.1, 0.1))
    assert together([one, one]) == Pass(20, 2.0, 1.0, 1e-3, (0.1, 0.1))


def test_cases_cover_lanes_processes_and_the_peer():
    lanes = full_lanes()
    found = {(c.solver, c.tets, c.envs, c.processes) for c in cases(peer="mujoco")}
    own = {("codesign", t, e, p) for t in (600, 2400) for e in (1, lanes) for p in (1, 2)}
    assert found == own | {("mujoco-flex", 600, 1, 1), ("mujoco-flex", 2400, 1, 1)}
    assert {c.device for c in cases("cuda")} == {"cpu", "cuda"}


def test_ratio_takes_full_lanes_of_one_process():
    def result(solver, envs, processes, per_cpu):
        rate = Rate(per_cpu, per_cpu, per_cpu)
        case = Case(solver, 600, envs, processes)
        return Result(case, rate, rate, 1e-3, 0.1, 0.1, True, True, 0, 1)

    results = [
        result("codesign", 1, 1, 300.0),
        result("codesign", 8, 1, 800.0),
        result("codesign", 8, 2, 700.0),
        result("mujoco-flex", 1, 1, 40.0),
    ]
    assert ratios(results) == {600: 20.0}
    assert ratios(results[:3]) == {}


def test_the_machine_is_described():
    machine = describe_machine()
    assert machine["lanes"] == full_lanes() >= 4
    assert machine["cores"] >= 1
    assert machine["cpu"]
