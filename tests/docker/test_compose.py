"""The image and the compose file against their formats and against this repository.

No Docker engine is needed: the compose specification's own JSON schema, as check-jsonschema ships
it, says whether Compose would take the file; the rest is compared with the sources it names.
"""

import ast
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
ROS = ROOT / "ros_ws" / "src"
COMPOSE_FILE = ROOT / "docker" / "compose.yaml"
COMPOSE = yaml.safe_load(COMPOSE_FILE.read_text())
SERVICES = COMPOSE["services"]
PROFILES = {
    name: yaml.safe_load((ROS / "codesign_bringup" / "config" / f"{name}.yaml").read_text())
    for name in ("sim", "real")
}


def validate(path: Path) -> subprocess.CompletedProcess[str]:
    command = ["-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", str(path)]
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=60)


def console_scripts(package: str) -> set[str]:
    """The executables that a package's setup.py installs."""
    names: set[str] = set()
    tree = ast.parse((ROS / package / "setup.py").read_text())
    constants = {
        target.id: ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "entry_points":
            scripts = eval(compile(ast.Expression(node.value), "setup.py", "eval"), constants)
            names |= {line.split(" = ")[0] for line in scripts["console_scripts"]}
    return names


def declared_parameters(node: str) -> dict[str, Any]:
    """Names of a node's parameters with their defaults; None where the default is computed."""
    path = ROS / "codesign_nodes" / "codesign_nodes" / f"{node}.py"
    found: dict[str, Any] = {"use_sim_time": False}  # of every node
    for call in ast.walk(ast.parse(path.read_text())):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "declare":
            name, default = call.args[1:3]
            if isinstance(name, ast.Constant):  # else one of many, whose names are worked out
                found[name.value] = default.value if isinstance(default, ast.Constant) else None
    return found


def words(service: dict[str, Any]) -> list[str]:
    """The command that a service runs in the end, past `bash -c 'exec ...'`."""
    command = service["command"]
    if command[:2] == ["bash", "-c"]:
        command = shlex.split(command[2])
        assert command.pop(0) == "exec", "without exec the shell would get the signals"
    return command


def by_default(text: str) -> str:
    """With the defaults of Compose's variables in their places."""
    return re.sub(r"\$\{\w+:-([^}]+)\}", r"\1", text)


def parameters(service: dict[str, Any]) -> dict[str, Any]:
    """What a service sets with -p name:=value, without variables from outside."""
    command = [by_default(word) for word in words(service)]
    settings = [command[k + 1] for k, word in enumerate(command) if word == "-p"]
    assert bool(settings) == ("--ros-args" in command)
    return {name: yaml.safe_load(value) for name, value in (s.split(":=") for s in settings)}


def instructions() -> Iterator[tuple[str, str]]:
    """Keyword and rest of each of the Dockerfile's instructions."""
    text = (ROOT / "docker" / "Dockerfile").read_text()
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        keyword, _, rest = line.strip().partition(" ")
        yield keyword, rest


def in_profile(name: str) -> list[dict[str, Any]]:
    return [s for s in SERVICES.values() if name in s["profiles"]]


def test_compose_file_meets_the_specification() -> None:
    result = validate(COMPOSE_FILE)
    assert result.returncode == 0, result.stdout + result.stderr


def test_validation_refuses_an_unknown_key(tmp_path: Path) -> None:
    services = {"policy": {"image": "codesign", "restrat": "no"}}
    (tmp_path / "compose.yaml").write_text(yaml.safe_dump({"services": services}))
    result = validate(tmp_path / "compose.yaml")
    assert result.returncode == 1
    assert "restrat" in result.stdout


@pytest.mark.parametrize("name", SERVICES)
def test_service_runs_an_executable_of_ours_with_parameters_it_declares(name: str) -> None:
    executable = words(SERVICES[name])[0]
    assert executable in console_scripts("codesign_nodes") | console_scripts("codesign_bringup")
    settings = parameters(SERVICES[name])
    if settings:
        declared = declared_parameters(executable)
        for parameter, value in settings.items():
            assert parameter in declared, f"{executable} declares no {parameter}"
            if declared[parameter] is not None:  # else a constant of a library, not seen here
                # ROS does not convert: 30 for a parameter of type double stops the node.
                assert type(value) is type(declared[parameter]), parameter


@pytest.mark.parametrize("profile", PROFILES)
def test_profile_holds_the_nodes_of_the_bring_up(profile: str) -> None:
    nodes = [words(s)[0] for s in in_profile(profile)]
    jobs = ["run_trials"] if profile == "sim" else []
    assert sorted(nodes) == sorted(PROFILES[profile]["nodes"] + jobs)


@pytest.mark.parametrize("profile", PROFILES)
def test_profile_sets_the_parameters_of_the_bring_up(profile: str) -> None:
    wanted = PROFILES[profile].get("parameters", {})
    settings = {words(s)[0]: parameters(s) for s in in_profile(profile)}
    for node, values in wanted.items():
        assert values.items() <= settings[node].items()


def test_the_real_profile_reaches_arm_and_camera() -> None:
    driver, camera = SERVICES["xarm_driver"], SERVICES["usb_camera"]
    assert driver["network_mode"] == "host"
    assert driver["ulimits"]["rtprio"] >= 50  # the streaming thread's priority
    assert [by_default(d) for d in camera["devices"]] == ["/dev/video0:/dev/video0"]
    dry = PROFILES["real"]["options"]["dry_run"]
    told = {words(s)[0] for s in in_profile("real") if "CODESIGN_DRY_RUN" in str(s["command"])}
    assert told == set(dry), "what bringup's --dry-run switches off, the variable does, too"


def test_trials_start_what_they_need() -> None:
    needed = [words(SERVICES[name])[0] for name in SERVICES["trials"]["depends_on"]]
    assert sorted(needed) == sorted(PROFILES["sim"]["nodes"])
    assert all("sim" in SERVICES[name]["profiles"] for name in SERVICES["trials"]["depends_on"])


def test_options_of_run_trials_exist() -> None:
    source = (ROS / "codesign_bringup" / "codesign_bringup" / "run_trials.py").read_text()
    for option in (word for word in words(SERVICES["trials"]) if word.startswith("--")):
        assert f'add_argument("{option}"' in source


def test_containers_share_one_host_one_image_and_the_results() -> None:
    workdir = next(rest for keyword, rest in instructions() if keyword == "WORKDIR")
    for service in SERVICES.values():
        assert service["image"] == "codesign:latest"
        assert service["network_mode"] == "host"
        assert "ROS_AUTOMATIC_DISCOVERY_RANGE" not in service["environment"]  # as in env.sh
        assert service["stop_signal"] == "SIGINT"
        assert service["init"] is True
        assert [v.rpartition(":")[2] for v in service["volumes"]] == [f"{workdir}/runs"]


def test_image_is_built_by_one_service_that_every_profile_has() -> None:
    (builder,) = (s for s in SERVICES.values() if "build" in s)
    assert set(builder["profiles"]) == set(PROFILES)
    context = (COMPOSE_FILE.parent / builder["build"]["context"]).resolve()
    assert context == ROOT
    assert (context / builder["build"]["dockerfile"]).is_file()


def test_variables_have_defaults() -> None:
    # `$$` is a dollar sign for the shell in the container, not a variable of Compose.
    text = COMPOSE_FILE.read_text().replace("$$", "")
    assert re.findall(r"\$(?!\{\w+:-[^}]+\})\S*", text) == []
    domain = (ROOT / "scripts" / "env.sh").read_text()
    environment = SERVICES["policy"]["environment"]["ROS_DOMAIN_ID"]
    assert environment in domain, "the host's shell and the containers meet on one domain"


def test_image_starts_from_ros_jazzy() -> None:
    assert [rest for keyword, rest in instructions() if keyword == "FROM"] == ["ros:jazzy"]


def test_image_copies_what_is_there_before_it_is_used() -> None:
    copied: set[str] = set()
    for keyword, rest in instructions():
        if keyword == "COPY":
            *sources, _ = [word for word in rest.split() if not word.startswith("--")]
            for source in sources:
                assert (ROOT / source).exists(), source
                copied.add(source.rstrip("/"))
        elif "scripts/setup.sh" in rest:
            assert {"scripts", "requirements", "src", "ros_ws/src", "pyproject.toml"} <= copied
    assert "." in copied


def test_image_runs_as_a_user_through_the_entry_point() -> None:
    last = dict(instructions())
    assert last["USER"] == "ubuntu"
    shell, path = json.loads(last["ENTRYPOINT"])
    assert shell == "bash"
    assert (ROOT / Path(path).relative_to(last["WORKDIR"])).is_file()


def test_what_set_up_and_runs_made_here_stays_out_of_the_image() -> None:
    clean = re.search(r"^clean:\n\trm -rf (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert clean
    kept_out = (ROOT / ".dockerignore").read_text().splitlines()
    assert {*clean[1].split(), ".git"} <= set(kept_out)
