"""Processes that simulate when they are told to, so that two can do so at the same time."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from codesign_sim.bench.cases import Case, Pass
from codesign_sim.bench.scenario import Fingers

_PAGE = os.sysconf("SC_PAGE_SIZE")
_MORE = 8  # times the environments, to see what one takes


class Workers:
    """A number of processes, started afresh and ended with the `with` block."""

    def __init__(self, count: int, fingers: Fingers) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes: list[Connection] = []
        self._processes = []
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, fingers), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in self._pipes:
            pipe.close()  # ends the worker's loop
        for process in self._processes:
            process.join()

    def prepare(self, case: Case) -> None:
        """Builds and warms up a case in as many processes as it wants."""
        self._ask(case.processes, "prepare", case)

    def run(self, case: Case, seconds: float) -> list[Pass]:
        """Grasps one after the other for about `seconds`, in all its processes at once."""
        return self._ask(case.processes, "run", case, seconds)

    def memory(self, case: Case) -> int:
        """Resident bytes that an environment more takes, in the first process."""
        return self._ask(1, "memory", case)[0]

    def _ask(self, count: int, *question: Any) -> list[Any]:
        for pipe in self._pipes[:count]:
            pipe.send(question)
        answers = [pipe.recv() for pipe in self._pipes[:count]]
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return answers


def _serve(pipe: Connection, fingers: Fingers) -> None:
    """A worker's loop: answers until the other end closes."""
    built: dict[Case, Any] = {}

    def grasp(case: Case) -> Any:
        if case not in built:
            built[case] = _build(case, fingers)
        return built[case]

    answers: dict[str, Callable[..., Any]] = {
        "prepare": lambda case: grasp(case) and None,
        "run": lambda case, seconds: _repeat(grasp(case), seconds),
        "memory": lambda case: _memory(case, fingers),
    }
    while True:
        try:
            name, *arguments = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(answers[name](*arguments))
        except Exception as error:
            pipe.send(error)


def _build(case: Case, fingers: Fingers) -> Any:
    if case.solver == "mujoco-flex":
        from codesign_sim.bench.mujoco_solver import MujocoGrasp

        return MujocoGrasp(case, fingers)
    from codesign_sim.bench.codesign_solver import CodesignGrasp

    return CodesignGrasp(case, fingers)


def _repeat(grasp: Any, seconds: float) -> Pass:
    passes = [grasp.run()]
    while sum(p.wall for p in passes) < seconds:
        passes.append(grasp.run())
    return together(passes)


def together(passes: Sequence[Pass]) -> Pass:
    """Passes one after the other as one."""
    return Pass(
        control_steps=sum(p.control_steps for p in passes),
        wall=sum(p.wall for p in passes),
        cpu=sum(p.cpu for p in passes),
        time_step=passes[-1].time_step,
        rise=passes[-1].rise,
        warnings=passes[-1].warnings,
    )


def _memory(case: Case, fingers: Fingers) -> int:
    few = _build(case, fingers)  # loads what all environments share
    before = _resident()
    more = _build(replace(case, envs=_MORE * case.envs), fingers)
    grown = _resident() - before
    del few, more
    return grown // (_MORE * case.envs)


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE
