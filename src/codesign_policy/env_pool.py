"""The control stage's lanes spread over worker processes, with the same results."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.lanes import (
    FINAL_INFO,
    STEP_INFO,
    Info,
    Step,
    check_options,
    check_swap,
    final_entries,
    observation_size,
    per_lane,
    set_spaces,
    swapped,
)
from codesign_policy.task import scaled_actions
from codesign_sim import warm_up

ANSWER_TIMEOUT = 120.0  # s, of a worker that lives; importing and the first reset take some
CLOSE_TIMEOUT = 5.0  # s, until a worker that does not end by itself is killed
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerError(RuntimeError):
    """A worker died, failed or fell silent; the pool is closed."""


@dataclass(frozen=True)
class _Worker:
    number: int
    lanes: slice
    process: Any
    pipe: Connection

    def __str__(self) -> str:
        return f"worker {self.number} (lanes {self.lanes.start} to {self.lanes.stop - 1})"


class PooledControlEnv(VectorEnv):
    """`ControlEnv` with its lanes in several processes, one thread each.

    Equal seeds and actions give the bits of one `ControlEnv` with as many lanes, as long as every
    process has four lanes or more. Workers are spawned, so a script that makes a pool guards its
    main part with `if __name__ == "__main__":`. They end with `close()`, with the interpreter,
    and, when it is killed, by themselves.
    """

    def __init__(
        self,
        num_envs: int,
        processes: int,
        fingers: FingerPair | Sequence[FingerPair] | None = None,
        config: ControlConfig | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        timeout: float = ANSWER_TIMEOUT,
    ) -> None:
        """Starts the workers, which takes a few seconds.

        Args:
            num_envs, fingers, config, autoreset_mode: as for `ControlEnv`.
            processes: workers, at most one per lane.
            timeout: longest wait for an answer of a worker that lives [s].
        Raises:
            ValueError: a setting outside its range.
            WorkerError: a worker did not start.
        """
        if not 1 <= processes <= num_envs:
            raise ValueError(f"{processes} processes for {num_envs} lanes: use 1 to {num_envs}")
        self._workers: list[_Worker] = []
        self.num_envs, self.config = num_envs, config or ControlConfig()
        self.metadata = {**ControlEnv.metadata, "autoreset_mode": autoreset_mode}
        self.fingers = per_lane(fingers, num_envs)
        set_spaces(self)
        self._timeout = timeout
        self._was_reset = np.zeros(num_envs, dtype=bool)
        warm_up()  # compiles once, not in every worker
        memory = _Memory.allocate(num_envs, observation_size(self.fingers))
        self._shared = memory.arrays()
        edges = np.linspace(0, num_envs, processes + 1).round().astype(int)
        with _one_thread():
            for number, (first, last) in enumerate(pairwise(edges.tolist())):
                self._spawn(number, slice(first, last), memory, autoreset_mode)
        self._collect(self._workers)

    def _spawn(
        self, number: int, lanes: slice, memory: _Memory, autoreset_mode: AutoresetMode
    ) -> None:
        context = mp.get_context("spawn")
        ours, theirs = context.Pipe()
        settings = (lanes, self.fingers[lanes], self.config, autoreset_mode)
        process = context.Process(
            target=_work,
            args=(theirs, memory, *settings),
            name=f"codesign-lanes-{number}",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._workers.append(_Worker(number, lanes, process, ours))

    # ---------------------------------------------------------- Gymnasium

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """As `ControlEnv.reset`."""
        super().reset(seed=seed)
        self._require_open()
        options = check_options(options, "reset_mask", "fingers")
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask {mask}: give {self.num_envs} flags, at least one True")
        if seed is None and not self._was_reset[mask].all():
            seed = int(self.np_random.integers(2**31))
        fingers = check_swap(options.get("fingers", {}), np.flatnonzero(mask))
        self.fingers = swapped(self.fingers, fingers)
        asked = [worker for worker in self._workers if mask[worker.lanes].any()]
        for worker in asked:
            first, last = worker.lanes.start, worker.lanes.stop
            own = None if seed is None else seed + first
            new = {lane - first: pair for lane, pair in fingers.items() if first <= lane < last}
            self._send(worker, ("reset", own, {"reset_mask": mask[first:last], "fingers": new}))
        self._collect(asked)
        self._was_reset |= mask
        return self._copy("observations"), {"episode_seed": self._copy("episode_seed")}

    def step(self, actions: NDArray[np.floating]) -> Step:
        """As `ControlEnv.step`.

        Raises:
            ValueError: an action that is not finite or beyond [-1, 1], naming the lane.
            WorkerError: a worker died, failed or fell silent; the pool is closed then.
        """
        self._require_open()
        scaled_actions(actions, self.num_envs)
        self._shared["actions"][:] = actions
        for worker in self._workers:
            self._send(worker, ("step",))
        self._collect(self._workers)
        info: Info = {name: self._copy(name) for name in STEP_INFO}
        ended = self._copy("ended")
        if ended.any():
            final = {name: self._copy(f"final_{name}") for name in FINAL_INFO}
            info.update(final_entries(ended, self._copy("final_obs"), final))
        names = ("observations", "rewards", "terminated", "truncated")
        observations, rewards, terminated, truncated = (self._copy(name) for name in names)
        return observations, rewards, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the workers; those that do not follow at once are killed."""
        for worker in self._workers:
            worker.pipe.close()  # which a waiting worker takes as its end
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for worker in self._workers:
            worker.process.join(max(0.0, deadline - time.monotonic()))
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
        self._workers = []

    # ------------------------------------------------------------- inside

    def _copy(self, name: str) -> NDArray:
        return self._shared[name].copy()

    def _require_open(self) -> None:
        if self.closed or not self._workers:
            raise WorkerError("the pool is closed: make a new one")

    def _send(self, worker: _Worker, message: tuple) -> None:
        try:
            worker.pipe.send(message)
        except OSError:
            self._fail(worker, _end_of(worker))

    def _collect(self, workers: Sequence[_Worker]) -> None:
        """Waits for the answers of these workers, while watching that all of them live."""
        waiting = {worker.pipe: worker for worker in workers}
        deadline = time.monotonic() + self._timeout
        while waiting:
            ready = wait(list(waiting), timeout=max(0.0, deadline - time.monotonic()))
            if not ready:
                worker = next(iter(waiting.values()))
                self._fail(worker, f"gave no answer within {self._timeout:g} s")
            for pipe in ready:
                worker = waiting.pop(pipe)  # type: ignore[call-overload]
                try:
                    error = worker.pipe.recv()
                except (EOFError, OSError):
                    error = _end_of(worker)
                if error:
                    self._fail(worker, error)

    def _fail(self, worker: _Worker, why: str) -> None:
        self.close()
        raise WorkerError(f"{worker} {why}")


def _end_of(worker: _Worker) -> str:
    worker.process.join(CLOSE_TIMEOUT)
    code = worker.process.exitcode
    if code is not None and code < 0:
        return f"died of signal {signal.Signals(-code).name} (exit code {code})"
    return f"ended with exit code {code}"


# ------------------------------------------------------------------- memory


@dataclass(frozen=True)
class _Memory:
    """Everything that parent and workers exchange, (E, ...) each, in shared memory.

    It has no name in the file system, so that nothing is left of it whoever is killed.
    """

    block: Any
    layout: dict[str, tuple[str, tuple[int, ...]]]

    @classmethod
    def allocate(cls, lanes: int, observation: int) -> _Memory:
        entries: dict[str, tuple[Any, tuple[int, ...]]] = {
            "actions": (float, (lanes, 7)),
            "observations": (np.float32, (lanes, observation)),
            "rewards": (float, (lanes,)),
            "terminated": (bool, (lanes,)),
            "truncated": (bool, (lanes,)),
            "episode_seed": (int, (lanes,)),
            "ended": (bool, (lanes,)),
            "final_obs": (np.float32, (lanes, observation)),
            **{name: (dtype, (lanes,)) for name, dtype in STEP_INFO.items()},
            **{f"final_{name}": (dtype, (lanes,)) for name, dtype in FINAL_INFO.items()},
        }
        layout = {name: (np.dtype(dtype).str, shape) for name, (dtype, shape) in entries.items()}
        size = sum(_bytes(*entry) for entry in layout.values())
        return cls(mp.get_context("spawn").RawArray("b", size), layout)

    def arrays(self) -> dict[str, NDArray]:
        """Views, by name."""
        views, offset = {}, 0
        for name, (dtype, shape) in self.layout.items():
            count = int(np.prod(shape))
            views[name] = np.frombuffer(self.block, dtype, count, offset).reshape(shape)
            offset += _bytes(dtype, shape)
        return views


def _bytes(dtype: str, shape: tuple[int, ...]) -> int:
    """Size in memory, rounded up so that what follows is aligned."""
    return -(-np.dtype(dtype).itemsize * int(np.prod(shape)) // 64) * 64


# ------------------------------------------------------------------- worker


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started meanwhile compute with one thread."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(
    pipe: Connection,
    memory: _Memory,
    lanes: slice,
    fingers: list[FingerPair],
    config: ControlConfig,
    autoreset_mode: AutoresetMode,
) -> None:
    """A worker's life: answers each message with None, or what went wrong."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    own = {name: view[lanes] for name, view in memory.arrays().items()}
    try:
        env = ControlEnv(lanes.stop - lanes.start, fingers, config, autoreset_mode)
        pipe.send(None)
        while True:
            command, *arguments = pipe.recv()
            if command == "step":
                _step(env, own)
            else:
                seed, options = arguments
                own["observations"][:], _ = env.reset(seed=seed, options=options)
                own["episode_seed"][:] = env.episode_seeds
            pipe.send(None)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent is gone, or has closed
    except Exception as error:
        pipe.send(f"failed: {type(error).__name__}: {error}\n{traceback.format_exc()}")


def _step(env: ControlEnv, own: Mapping[str, NDArray]) -> None:
    observations, rewards, terminated, truncated, info = env.step(own["actions"])
    own["observations"][:], own["rewards"][:] = observations, rewards
    own["terminated"][:], own["truncated"][:] = terminated, truncated
    own["episode_seed"][:] = env.episode_seeds
    for name in STEP_INFO:
        own[name][:] = info[name]
    own["ended"][:] = False
    if "final_obs" in info:
        own["ended"][:] = info["_final_obs"]
        own["final_obs"][:] = info["final_obs"]
        for name in FINAL_INFO:
            own[f"final_{name}"][:] = info["final_info"][name]
