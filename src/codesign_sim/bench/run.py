"""Measures the cases in turn, several times over, so that a noisy machine spoils none alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from codesign_sim.bench.cases import Case, Pass, Rate, Result
from codesign_sim.bench.machine import full_lanes
from codesign_sim.bench.scenario import RISE, RISE_HELD, Fingers
from codesign_sim.bench.workers import Workers

TETS = (600, 2400)
CUDA_ENVS = 2048
REPETITIONS = 3

Progress = Callable[[str, int, int], None]


def cases(device: str = "cpu", peer: str | None = None) -> list[Case]:
    """One environment and full lanes, in one and two processes; and the peer, one of each size."""
    lanes = full_lanes()
    own = [
        Case("codesign", tets, envs, processes)
        for tets in TETS
        for envs in (1, lanes)
        for processes in (1, 2)
    ]
    gpu = [Case("codesign", tets, CUDA_ENVS, 1, device) for tets in TETS if device != "cpu"]
    other = [Case(f"{peer}-flex", tets, 1, 1) for tets in TETS if peer]
    return own + gpu + other


def run(
    cases: Sequence[Case],
    fingers: Fingers,
    seconds: float = 3.0,
    progress: Progress | None = None,
) -> list[Result]:
    """Measures every case.

    Each is built and warmed up, which is not timed; then the cases take turns, three times, each
    with whole grasps for a third of `seconds`. The medians are the result.

    Args:
        cases: what to measure.
        fingers: (left, right) surfaces in the grasp frame at gap 0, with a flat face.
        seconds: wall time per case, exceeded where a grasp takes longer.
        progress: called with (what, done, in all).
    """
    total = len(cases) * (REPETITIONS + 1)
    say = progress or (lambda *_: None)
    passes: dict[Case, list[list[Pass]]] = {case: [] for case in cases}
    with Workers(max(case.processes for case in cases), fingers) as workers:
        for done, case in enumerate(cases):
            say("warm-up", done, total)
            workers.prepare(case)
        for repetition in range(REPETITIONS):
            for k, case in enumerate(cases):
                say(f"{case.solver} {case.tets}", (repetition + 1) * len(cases) + k, total)
                passes[case].append(workers.run(case, seconds / REPETITIONS))
    say("memory", total, total)
    memory = {key: _memory(*key, fingers) for key in {(c.solver, c.tets) for c in cases}}
    return [_result(case, passes[case], memory[case.solver, case.tets]) for case in cases]


def ratios(results: Sequence[Result]) -> dict[int, float]:
    """Control steps per CPU second over the peer's, full lanes in one process, by tetrahedra."""
    peers = {r.case.tets: r for r in results if r.case.solver != "codesign"}
    own = [
        r
        for r in results
        if (r.case.solver, r.case.device, r.case.processes) == ("codesign", "cpu", 1)
    ]
    return {
        tets: max((r for r in own if r.case.tets == tets), key=lambda r: r.case.envs).cpu.median
        / peer.cpu.median
        for tets, peer in peers.items()
    }


def _memory(solver: str, tets: int, fingers: Fingers) -> int:
    """In a process of its own: what was freed stays resident, and would count for nothing."""
    with Workers(1, fingers) as worker:
        return worker.memory(Case(solver, tets, full_lanes(), 1))


def _result(case: Case, repetitions: list[list[Pass]], memory: int) -> Result:
    """Processes add up; repetitions are compared."""
    last = repetitions[-1]
    after_lift, after_hold = last[0].rise
    return Result(
        case=case,
        wall=Rate.of([sum(p.control_steps / p.wall for p in r) for r in repetitions]),
        cpu=Rate.of([sum(p.control_steps for p in r) / sum(p.cpu for p in r) for r in repetitions]),
        time_step=last[0].time_step,
        rise_after_lift=after_lift,
        rise_after_hold=after_hold,
        lifted=after_lift > RISE_HELD * RISE,
        held=after_hold > RISE_HELD * RISE,
        warnings=sum(p.warnings for p in last),
        bytes_per_environment=memory,
    )
