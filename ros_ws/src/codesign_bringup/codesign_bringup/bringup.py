"""Starts the graph, forwards its logs, and stops all of it together.

    bringup sim                            until Ctrl-C
    bringup sim -- run_trials --count 3    until that job ends; its exit code is ours
    bringup sim --set fem_simulator.tetrahedra=600 --lockstep
    bringup real --set xarm_driver.address=192.168.1.200 --dry-run

Exit codes: the job's; 0 after Ctrl-C; 3 when a node died; 2 for bad arguments.
"""

import argparse
import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)

NODE_DIED = 3
GRACE = 5.0  # s after SIGINT, and again after SIGTERM
FIFO_PRIORITY = 10  # of 1..99: before everything normal, behind what the system runs there
PROFILES_FILE = "FASTRTPS_DEFAULT_PROFILES_FILE"  # read by Fast DDS
_PR_SET_PDEATHSIG = 1


@dataclass
class Child:
    """A started process."""

    name: str
    process: subprocess.Popen[str]


class Graph:
    """The processes of one bring-up. Use it as a context: leaving it stops them all."""

    def __init__(self, log_folder: Path | None = None, *, quiet: bool = False) -> None:
        """Args: folder for one log file per node, if wanted; quiet: nothing on the terminal."""
        self._children: list[Child] = []
        self._log_folder = log_folder
        self._quiet = quiet
        if log_folder:
            log_folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> "Graph":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(
        self,
        name: str,
        parameters: dict[str, Any] | None = None,
        *,
        lockstep: bool = False,
        nice: int = 0,
        realtime: bool = False,
    ) -> Child:
        """Starts one node of codesign_nodes with these parameters.

        Where permitted with this niceness, or under the real-time scheduler SCHED_FIFO.
        """
        command = [str(executable("codesign_nodes", name)), "--ros-args"]
        for key, value in ({"use_sim_time": lockstep} | (parameters or {})).items():
            command += [
                "-p",
                f"{key}:={yaml.safe_dump(value, default_flow_style=True).split(chr(10))[0]}",
            ]
        process = _spawn(command, nice, realtime, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        child = Child(name, process)
        self._children.append(child)
        threading.Thread(target=self._forward, args=(child,), daemon=True).start()
        return child

    def died(self) -> Child | None:
        """The first node that is no longer running, if any."""
        return next((c for c in self._children if c.process.poll() is not None), None)

    def stop(self) -> None:
        """Ends every process: SIGINT, then SIGTERM, then SIGKILL, to whole process groups."""
        for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            alive = [c for c in self._children if c.process.poll() is None]
            for child in alive:
                _signal_group(child.process, sign)
            _wait_all(alive, GRACE)
        self._children.clear()

    def _forward(self, child: Child) -> None:
        log = (self._log_folder / f"{child.name}.log").open("w") if self._log_folder else None
        assert child.process.stdout is not None
        for line in child.process.stdout:
            if not self._quiet:
                print(f"[{child.name}] {line}", end="", file=sys.stderr, flush=True)
            if log:
                log.write(line)
                log.flush()
        if log:
            log.close()


def executable(package: str, name: str) -> Path:
    """Path of an installed executable.

    Raises:
        FileNotFoundError: with the remedy.
    """
    try:
        path = Path(get_package_prefix(package), "lib", package, name)
    except PackageNotFoundError:
        raise FileNotFoundError(
            f"ROS package {package} is not on the path: run `make setup`, then `. scripts/env.sh`"
        ) from None
    if not path.exists():
        raise FileNotFoundError(f"{package} has no executable {name}: {path} is not there")
    return path


def load_profile(name: str) -> dict[str, Any]:
    """A profile by its name, or by the path of a YAML file of the same form.

    Raises:
        FileNotFoundError: no such profile.
        ValueError: no list of nodes in it.
    """
    folder = Path(get_package_share_directory("codesign_bringup"), "config")
    path = Path(name) if name.endswith(".yaml") else folder / f"{name}.yaml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
        raise FileNotFoundError(f"profile {name}: not found; there are {known}")
    profile = yaml.safe_load(path.read_text())
    if not isinstance(profile, dict) or not profile.get("nodes"):
        raise ValueError(f"profile {path}: has no list `nodes`")
    for parameters in profile.get("parameters", {}).values():
        parameters |= {key: resolved(value) for key, value in parameters.items()}
    return profile


def resolved(value: Any) -> Any:
    """The path of a "package://NAME/PATH", in NAME's share folder; anything else as it is.

    Raises:
        FileNotFoundError: no such package.
    """
    if not isinstance(value, str) or not value.startswith("package://"):
        return value
    package, _, path = value.removeprefix("package://").partition("/")
    try:
        return str(Path(get_package_share_directory(package), path))
    except PackageNotFoundError:
        raise FileNotFoundError(f"{value}: there is no package {package}") from None


def parse_settings(settings: list[str]) -> dict[str, dict[str, Any]]:
    """["node.parameter=value"] as {node: {parameter: value}}; values are YAML.

    Raises:
        ValueError: not of that form.
    """
    parsed: dict[str, dict[str, Any]] = {}
    for setting in settings:
        path, equals, value = setting.partition("=")
        node, dot, parameter = path.partition(".")
        if not (equals and dot and node and parameter):
            raise ValueError(f"--set {setting}: must be node.parameter=value")
        parsed.setdefault(node, {})[parameter] = resolved(yaml.safe_load(value))
    return parsed


def with_options(profile: dict[str, Any], options: list[str]) -> dict[str, dict[str, Any]]:
    """{node: {parameter: value}} of what the profile lists under these options, such as dry_run.

    Raises:
        ValueError: the profile has no such option.
    """
    offered = profile.get("options", {})
    merged: dict[str, dict[str, Any]] = {}
    for option in options:
        if option not in offered:
            known = ", ".join(f"--{o.replace('_', '-')}" for o in offered) or "no such option"
            raise ValueError(f"--{option.replace('_', '-')}: this profile has {known}")
        for node, values in offered[option].items():
            merged[node] = merged.get(node, {}) | values
    return merged


def without(profile: dict[str, Any], nodes: list[str]) -> dict[str, Any]:
    """The profile without these nodes.

    Raises:
        ValueError: it has no such node.
    """
    unknown = sorted(set(nodes) - set(profile["nodes"]))
    if unknown:
        raise ValueError(
            f"--without {', '.join(unknown)}: not in this profile; there are "
            f"{', '.join(profile['nodes'])}"
        )
    return profile | {"nodes": [node for node in profile["nodes"] if node not in nodes]}


def run_graph(
    profile: dict[str, Any],
    settings: dict[str, dict[str, Any]],
    job: list[str],
    *,
    lockstep: bool,
    log_folder: Path | None,
    quiet: bool,
    options: list[str] | None = None,
) -> int:
    """Runs a profile until its job ends, a node dies or a signal comes; returns the exit code."""
    chosen = with_options(profile, options or [])
    unknown = set(settings) - set(profile["nodes"])
    if unknown:
        raise ValueError(f"--set names {', '.join(sorted(unknown))}: not in this profile")
    interrupted = threading.Event()

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        interrupted.set()

    for sign in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sign, interrupt)
    with Graph(log_folder, quiet=quiet) as graph:
        defaults = profile.get("parameters", {})
        for node in profile["nodes"]:
            graph.start(
                node,
                defaults.get(node, {}) | chosen.get(node, {}) | settings.get(node, {}),
                lockstep=lockstep,
                # Simulated time waits for everybody; only the wall clock needs priorities.
                nice=0 if lockstep else profile.get("nice", {}).get(node, 0),
                realtime=not lockstep and node in profile.get("realtime", []),
            )
        process = _spawn(_job_command(job)) if job else None
        try:
            return _watch(graph, process, interrupted)
        finally:
            if process is not None:
                _end(process)


def _watch(graph: Graph, job: subprocess.Popen[str] | None, interrupted: threading.Event) -> int:
    while not interrupted.wait(0.1):
        if job is not None and job.poll() is not None:
            return job.returncode
        dead = graph.died()
        if dead is not None:
            print(
                f"bringup: {dead.name} ended with exit code {dead.process.returncode}; "
                "stopping the others",
                file=sys.stderr,
            )
            return NODE_DIED
    return 0 if job is None else 130


def _job_command(job: list[str]) -> list[str]:
    """A job named like one of our executables is that executable."""
    own = Path(get_package_prefix("codesign_bringup"), "lib", "codesign_bringup", job[0])
    return [str(own), *job[1:]] if own.exists() else job


def _spawn(
    command: list[str], nice: int = 0, realtime: bool = False, **options: Any
) -> subprocess.Popen[str]:
    environment = {
        **_on_this_host(),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    } | os.environ
    # A group of its own: Ctrl-C on the terminal reaches us only, and we stop the children in
    # order. Should we be killed, the kernel ends them.
    return subprocess.Popen(
        command,
        text=True,
        env=environment,
        start_new_session=True,
        preexec_fn=lambda: _before_exec(nice, realtime),
        **options,
    )


def _on_this_host() -> dict[str, str]:
    """Variables with which DDS stays on this host, as in scripts/env.sh; what is set already goes
    before them."""
    chosen = {"ROS_AUTOMATIC_DISCOVERY_RANGE", PROFILES_FILE} & os.environ.keys()
    if chosen or not os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps").startswith(
        "rmw_fastrtps"
    ):
        return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    profile = Path(get_package_share_directory("codesign_bringup"), "config", "fastdds.xml")
    return {PROFILES_FILE: str(profile), "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}


def _before_exec(nice: int, realtime: bool) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    with contextlib.suppress(PermissionError):
        os.nice(nice)
        if nice:
            _nice_session(nice)
        if realtime:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))


def _nice_session(nice: int) -> None:
    """Linux weighs sessions against each other where it groups them; niceness counts only within.

    Every node has a session of its own.
    """
    group = Path("/proc/self/autogroup")
    if group.exists():
        group.write_text(f"{nice}\n")


def _end(process: subprocess.Popen[str]) -> None:
    for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        _signal_group(process, sign)
        _wait_all([Child("job", process)], GRACE)


def _signal_group(process: subprocess.Popen[str], sign: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, sign)


def _wait_all(children: list[Child], timeout: float) -> None:
    deadline = time.monotonic() + timeout
    for child in children:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(max(0.0, deadline - time.monotonic()))


def main() -> None:
    """Command line; see the module's docstring."""
    arguments = sys.argv[1:]
    job: list[str] = []
    if "--" in arguments:
        split = arguments.index("--")
        arguments, job = arguments[:split], arguments[split + 1 :]
    parser = argparse.ArgumentParser(
        prog="bringup", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("profile", help="sim, real, or a YAML file with a list of nodes")
    parser.add_argument(
        "--lockstep",
        action="store_true",
        help="simulated time, as fast as it goes, repeatable bit for bit",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NODE.PARAMETER=VALUE",
        help="a node's parameter, as YAML; may be given several times",
    )
    parser.add_argument(
        "--dry-run",
        dest="options",
        action="append_const",
        const="dry_run",
        help="everything runs, nothing moves (profiles with an arm)",
    )
    parser.add_argument(
        "--slow",
        dest="options",
        action="append_const",
        const="slow",
        help="reduced speed, for first moves (profiles with an arm)",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="NODE",
        help="leave a node out, where another program does its work; may be given several times",
    )
    parser.add_argument("--log-folder", type=Path, help="one log file per node goes there")
    parser.add_argument("--quiet", action="store_true", help="no node logs on the terminal")
    options = parser.parse_args(arguments)
    try:
        profile = without(load_profile(options.profile), options.without)
        settings = parse_settings(options.set)
        if "dry_run" in (options.options or []):
            print("bringup: DRY RUN, nothing will move", file=sys.stderr)
        code = run_graph(
            profile,
            settings,
            job,
            lockstep=options.lockstep,
            log_folder=options.log_folder,
            quiet=options.quiet,
            options=options.options,
        )
    except (FileNotFoundError, ValueError) as error:
        print(f"bringup: {error}", file=sys.stderr)
        code = 2
    sys.exit(code)
