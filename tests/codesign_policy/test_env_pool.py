"""Lanes in worker processes: the same bits, and an end to every worker."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.env_pool import PooledControlEnv, WorkerError
from codesign_policy.lanes import FINAL_INFO
from codesign_policy.tool import ToolStart

CONFIG = ControlConfig(start=ToolStart((0.45, 0.0, 0.01), 0.05), episode_steps=15)
STILL = np.zeros((8, 7))
HELP = 10.0  # s, within which everything here must have come to an end

OWNER = """
import numpy as np
from codesign_policy.control_env import ControlConfig
from codesign_policy.env_pool import PooledControlEnv
if __name__ == "__main__":
    pool = PooledControlEnv(4, 1, config=ControlConfig(episode_steps=15))
    pool.reset(seed=0)
    print(*[worker.process.pid for worker in pool._workers], flush=True)
    while True:
        pool.step(np.zeros((4, 7)))
"""


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def await_end(pids: list[int]) -> None:
    deadline = time.monotonic() + HELP
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "workers are left over"
        time.sleep(0.05)


def pids_of(pool: PooledControlEnv) -> list[int]:
    return [worker.process.pid for worker in pool._workers]


@pytest.fixture
def pool():
    made = PooledControlEnv(8, 2, config=CONFIG)
    yield made
    pids = pids_of(made)
    made.close()
    assert not any(alive(pid) for pid in pids)


def test_gives_the_bits_of_one_process_and_closes(pool: PooledControlEnv) -> None:
    alone = ControlEnv(8, config=CONFIG)
    assert pool.observation_space == alone.observation_space
    random = np.random.default_rng(0)
    for one, other in zip(pool.reset(seed=4), alone.reset(seed=4), strict=True):
        _assert_same(one, other)
    for step in range(35):  # two episodes end meanwhile, and one reset from outside
        if step == 20:
            mask = np.arange(8) == 6
            options = {"reset_mask": mask, "fingers": {6: stock_fingers(edge_radius=0.0014)}}
            for one, other in zip(
                pool.reset(options=options), alone.reset(options=options), strict=True
            ):
                _assert_same(one, other)
        if step % 5 == 0:
            actions = random.uniform(-1, 1, (8, 7))
        one, other = pool.step(actions), alone.step(actions)
        for a, b in zip(one, other, strict=True):
            _assert_same(a, b)
    assert set(FINAL_INFO) <= set(other[4].get("final_info", FINAL_INFO))
    pids = pids_of(pool)
    pool.close()
    pool.close()
    assert not any(alive(pid) for pid in pids)
    with pytest.raises(WorkerError, match="closed: make a new one"):
        pool.step(STILL)


def _assert_same(one: object, other: object) -> None:
    if isinstance(one, dict):
        assert isinstance(other, dict)
        assert one.keys() == other.keys()
        for name, value in one.items():
            _assert_same(value, other[name])
    else:
        assert np.array_equal(one, other, equal_nan=np.asarray(one).dtype.kind == "f")


def test_a_killed_worker_is_an_error_that_names_it(pool: PooledControlEnv) -> None:
    pool.reset(seed=0)
    with pytest.raises(ValueError, match="lane 7: dx is nan"):
        pool.step(np.where(np.arange(8)[:, None] == 7, np.nan, STILL))
    pool.step(STILL)  # a bad action does no harm
    victims = pids_of(pool)
    os.kill(victims[1], signal.SIGKILL)
    started = time.monotonic()
    why = r"worker 1 \(lanes 4 to 7\) died of signal SIGKILL \(exit code -9\)"
    with pytest.raises(WorkerError, match=why):
        pool.step(STILL)
    assert time.monotonic() < started + HELP
    assert not any(alive(pid) for pid in victims)
    with pytest.raises(WorkerError, match="closed"):
        pool.reset(seed=0)


def test_a_worker_that_stands_still_is_an_error() -> None:
    pool = PooledControlEnv(4, 1, config=CONFIG)
    pool.reset(seed=0)
    pool._timeout = 1.0
    os.kill(pids_of(pool)[0], signal.SIGSTOP)
    with pytest.raises(WorkerError, match=r"worker 0 .* gave no answer within 1 s"):
        pool.step(STILL[:4])


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGINT])
def test_no_worker_outlives_its_owner(tmp_path: Path, blow: int) -> None:
    script = tmp_path / "owner.py"
    script.write_text(OWNER)
    owner = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        assert owner.stdout is not None
        workers = [int(pid) for pid in owner.stdout.readline().split()]
        assert len(workers) == 1
        assert all(alive(pid) for pid in workers)
        # Ctrl-C reaches the whole group, as from a terminal.
        (os.killpg if blow == signal.SIGINT else os.kill)(owner.pid, blow)
        owner.wait(HELP)
        await_end(workers)
    finally:
        owner.kill()
        owner.wait()
        owner.stdout.close()


def test_an_error_in_a_worker_is_told_with_its_cause() -> None:
    bad = ControlConfig(tetrahedra=601)
    with pytest.raises(WorkerError, match=r"worker 0.*(?s:.)*no tofu mesh of 601"):
        PooledControlEnv(4, 1, config=bad)


def test_refuses_more_processes_than_lanes() -> None:
    with pytest.raises(ValueError, match="9 processes for 8 lanes: use 1 to 8"):
        PooledControlEnv(8, 9)
