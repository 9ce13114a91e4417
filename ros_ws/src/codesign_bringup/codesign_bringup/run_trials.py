"""Runs trials one after the other through the action /run_trial, and writes their results.

    run_trials --count 3 --out runs/mine
    run_trials --policy codesign --policy original --count 3    both on the same seeds

Exit codes: 0 all succeeded, 1 one did not, 3 the graph did not answer.
"""

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import rclpy
from codesign_interfaces.action import RunTrial
from codesign_interfaces.msg import TrialDomain
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from codesign_policy.policy import policy_label

NO_ANSWER = 3
WORDS = {1: "preparing", 2: "running", 3: "finished", 4: "failed"}


class GraphError(RuntimeError):
    """The graph does not answer, or refuses; the message says which."""


class TrialClient(Node):
    """Sends one goal at a time."""

    def __init__(self) -> None:
        super().__init__("run_trials")
        self._client = ActionClient(self, RunTrial, "/run_trial")
        self._policy = AsyncParameterClient(self, "policy")

    def wait_for_graph(self, timeout: float) -> bool:
        """Whether the trial runner is there within `timeout` [s]."""
        return self._client.wait_for_server(timeout)

    def choose(self, policy: str) -> None:
        """Has the policy node serve this one.

        Raises:
            GraphError: no answer, or the node refuses.
        """
        if not self._policy.wait_for_services(60.0):
            raise GraphError("no node policy within 60 s: is the graph up?")
        for _ in range(3):  # a reply may be lost while the nodes still find each other
            asked = self._policy.set_parameters([Parameter("policy", value=policy)])
            rclpy.spin_until_future_complete(self, asked, timeout_sec=5.0)
            if asked.done():
                (result,) = asked.result().results
                if not result.successful:
                    raise GraphError(result.reason)
                return
        raise GraphError("the node policy does not answer: see its log")

    def run(self, goal: RunTrial.Goal, on_feedback: Any, timeout: float) -> RunTrial.Result | None:
        """The result of one trial, or None when nothing came back within `timeout` [s]."""
        sent = self._client.send_goal_async(goal, feedback_callback=on_feedback)
        rclpy.spin_until_future_complete(self, sent, timeout_sec=10.0)
        handle = sent.result() if sent.done() else None
        if handle is None or not handle.accepted:
            return None
        future = handle.get_result_async()
        rclpy.spin_until_future_complete(self, future, timeout_sec=timeout)
        return future.result().result if future.done() else None


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="run_trials", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=3, help="how many trials")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial; then one up each")
    parser.add_argument(
        "--policy",
        action="append",
        help="what the policy node is to serve, which then is the label; may be given several "
        "times (default: what it serves already)",
    )
    parser.add_argument("--gripper", default="stock", help="label of the results without --policy")
    parser.add_argument("--out", type=Path, help="folder for bags and trials.json")
    parser.add_argument("--timeout", type=float, default=180.0, help="per trial, wall time [s]")
    options = parser.parse_args()
    rclpy.init()
    try:
        code = _run(options)
    except (KeyboardInterrupt, ExternalShutdownException):
        code = 130
    finally:
        rclpy.try_shutdown()
    sys.exit(code)


def _run(options: argparse.Namespace) -> int:
    client = TrialClient()
    console = Console(stderr=True)
    try:
        with _progress(console) as progress:
            results = _all_trials(client, options, console, progress)
    except GraphError as error:
        console.print(f"run_trials: {error}", soft_wrap=True)
        return NO_ANSWER
    if options.out:
        _write_atomically(options.out / "trials.json", json.dumps({"trials": results}, indent=2))
    return 0 if all(r["success"] for r in results) else 1


def _all_trials(
    client: TrialClient, options: argparse.Namespace, console: Console, progress: Progress
) -> list[dict[str, Any]]:
    """Policy by policy, so that fingers are changed once each."""
    task = progress.add_task("waiting for the graph", total=None)
    if not client.wait_for_graph(60.0):
        raise GraphError("no action /run_trial within 60 s: is the graph up?")
    results = []
    for policy in options.policy or [None]:
        if policy is not None:
            client.choose(policy)
        gripper = policy_label(policy) if policy else options.gripper
        for seed in range(options.seed, options.seed + options.count):
            name = f"{gripper}-seed{seed}"
            goal = _goal(options.out, gripper, seed)
            result = client.run(goal, _feedback(progress, task, name), options.timeout)
            if result is None:
                raise GraphError(f"{name}: no result within {options.timeout} s")
            results.append(_as_json(gripper, seed, result))
            verdict = "success" if result.success else f"FAILED: {result.message}"
            console.print(f"{name}: {verdict}", soft_wrap=True)
    return results


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TimeElapsedColumn(),
        console=console,
    )


def _goal(out: Path | None, gripper: str, seed: int) -> RunTrial.Goal:
    bag = str((out / f"{gripper}-seed{seed}").resolve()) if out else ""
    undrawn = dict.fromkeys(TrialDomain.get_fields_and_field_types(), math.nan)
    return RunTrial.Goal(gripper=gripper, seed=seed, bag=bag, domain=TrialDomain(**undrawn))


def _feedback(progress: Progress, task: Any, name: str) -> Any:
    def show(message: Any) -> None:
        state = message.feedback.state
        words = WORDS.get(state.state, "")
        progress.update(task, description=f"{name}: {words}, {state.elapsed:4.1f} s simulated")

    return show


def _as_json(gripper: str, seed: int, result: RunTrial.Result) -> dict[str, Any]:
    metrics = {k: getattr(result.metrics, k) for k in result.metrics.get_fields_and_field_types()}
    domain = {k: getattr(result.domain, k) for k in result.domain.get_fields_and_field_types()}
    return {
        "gripper": gripper,
        "seed": seed,
        "success": result.success,
        "message": result.message,
        "metrics": metrics,
        "domain": domain,
        "bag": result.bag,
    }


def _write_atomically(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(text)
    os.replace(part, path)
