"""The container files say what they should. No engine runs here: these tests read them as an engine would."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from service.cli import _parser
from service.settings import Settings

REPOSITORY = Path(__file__).resolve().parents[2]
OURS = ["api", "worker"]


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((REPOSITORY / "docker-compose.yml").read_text())
    return document


@pytest.fixture(scope="module")
def stages() -> list[list[tuple[str, str]]]:
    """The Dockerfile as stages of (instruction, arguments), continuation lines joined, comments removed."""
    lines = (REPOSITORY / "Dockerfile").read_text().splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#")).replace("\\\n", " ")
    steps = [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]
    found: list[list[tuple[str, str]]] = []
    for word, arguments in steps:
        if word == "FROM":
            found.append([])
        if found:
            found[-1].append((word, arguments))
    return found


def test_it_has_three_services_and_more_by_profile(compose: dict[str, Any]) -> None:
    profiles = {name: service.get("profiles", []) for name, service in compose["services"].items()}
    assert profiles == {
        "api": [],
        "worker": [],
        "redis": [],
        "postgres": ["scale"],
        "worker-gpu": ["scale-gpu"],
    }
    assert set(compose["volumes"]) == {"data", "queue", "postgres"}


@pytest.mark.parametrize("name", ["api", "worker", "redis", "postgres", "worker-gpu"])
def test_every_service_is_locked_down_limited_and_watched(compose: dict[str, Any], name: str) -> None:
    service = compose["services"][name]
    user, _, group = service["user"].partition(":")
    assert int(user) > 0
    assert int(group) > 0
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["init"] is True
    assert service["restart"] == "unless-stopped"
    assert "mem_limit" in service
    assert service["pids_limit"] > 0
    assert [mount for mount in service["tmpfs"] if mount.startswith("/tmp:") and "noexec" in mount]
    assert service["healthcheck"]["test"][0] == "CMD"
    assert not {"privileged", "network_mode", "pid", "ipc", "cap_add", "devices"} & set(service)
    assert all(":" in volume and not volume.startswith((".", "/")) for volume in service["volumes"])


def test_only_the_api_is_published_and_only_on_loopback(compose: dict[str, Any]) -> None:
    ports = {name: service.get("ports", []) for name, service in compose["services"].items()}
    assert ports.pop("api") == ["127.0.0.1:${MASS_PORT:-8000}:8000"]
    assert not any(ports.values())
    assert compose["networks"]["queue"]["internal"] == "${MASS_ISOLATED:-true}"
    for name in ports:
        assert compose["services"][name]["networks"] == ["queue"]


def test_the_figures_are_on_a_port_that_is_not_published(compose: dict[str, Any]) -> None:
    api = compose["services"]["api"]
    port = api["environment"]["MASS_METRICS_PORT"]
    assert Settings(metrics_port=int(port)).metrics_port == int(port)
    assert not any(entry.endswith(f":{port}") for entry in api["ports"])
    assert "queue" in api["networks"]


def test_api_and_worker_share_one_image_user_volume_and_broker(compose: dict[str, Any]) -> None:
    api, worker = (compose["services"][name] for name in OURS)
    for key in ("image", "build", "user", "volumes", "depends_on"):
        assert api[key] == worker[key]
    shared = {name: value for name, value in worker["environment"].items() if name != "MASS_WORKER_QUEUES"}
    figures = {"MASS_METRICS_HOST": "0.0.0.0", "MASS_METRICS_PORT": "9090"}
    assert api["environment"] == {**shared, "MASS_AUTH": "${MASS_AUTH:-open}", **figures}
    gpu = compose["services"]["worker-gpu"]
    assert {**shared, **gpu["environment"]} == gpu["environment"]
    assert gpu["environment"]["MASS_WORKER_QUEUES"] == '["gpu"]'
    assert api["volumes"] == ["data:/data"]
    assert api["depends_on"] == {"redis": {"condition": "service_healthy"}}
    host = re.fullmatch(r"redis://([^:/]+):6379/0", api["environment"]["MASS_REDIS_URL"])
    assert host is not None
    assert host.group(1) in compose["services"]


def test_the_queue_is_kept_on_disk_and_never_evicts(compose: dict[str, Any]) -> None:
    redis = compose["services"]["redis"]
    words = redis["command"]
    flags = dict(zip(words[1::2], words[2::2], strict=True))
    assert flags["--appendonly"] == "yes"
    assert flags["--maxmemory-policy"] == "noeviction"
    assert redis["volumes"] == ["queue:/data"]


def test_the_commands_exist(compose: dict[str, Any], stages: list[list[tuple[str, str]]]) -> None:
    api, worker = (compose["services"][name] for name in OURS)
    program, *arguments = api["command"]
    assert program == "mass"
    options = _parser().parse_args(arguments)
    assert (options.host, options.port) == ("0.0.0.0", 8000)
    assert worker["command"][:2] == ["python", "-m"]
    assert worker["healthcheck"]["test"][1:3] == ["python", "-m"]
    for module in (worker["command"][2], worker["healthcheck"]["test"][3]):
        assert find_spec(module) is not None
    compile(api["healthcheck"]["test"][3], "healthcheck", "exec")
    assert "/healthz" in api["healthcheck"]["test"][3]
    command = next(arguments for word, arguments in stages[-1] if word == "CMD")
    _parser().parse_args(yaml.safe_load(command)[1:])


def test_every_variable_set_is_one_that_is_read(
    compose: dict[str, Any], stages: list[list[tuple[str, str]]]
) -> None:
    known = {f"MASS_{name.upper()}" for name in Settings.model_fields} | {"MASS_MODEL_DIR"}
    in_image = [
        word.partition("=")[0] for step, rest in stages[-1] if step == "ENV" for word in shlex.split(rest)
    ]
    in_compose = [
        name for service in (*OURS, "worker-gpu") for name in compose["services"][service]["environment"]
    ]
    assert {name for name in [*in_image, *in_compose] if name.startswith("MASS_")} <= known
    assert {"MASS_DATA_DIR", "MASS_MODEL_DIR"} <= set(in_image)


def test_the_image_runs_as_nobody_special_and_carries_no_compiler(
    stages: list[list[tuple[str, str]]],
) -> None:
    build, run = stages
    assert any("g++" in rest for word, rest in build if word == "RUN")
    assert not any("apt-get" in rest or "pip " in rest for word, rest in run if word == "RUN")
    assert [rest for word, rest in run if word == "USER"] == ["10001:10001"]
    assert all(rest.startswith("--from=build ") for word, rest in run if word == "COPY")
    assert any("mass_engine.tracking.models" in rest for word, rest in build if word == "RUN")


def test_the_build_sees_exactly_what_it_copies(stages: list[list[tuple[str, str]]]) -> None:
    copied = {
        word for step, rest in stages[0] if step == "COPY" for word in rest.split()[:-1] if word != "./"
    }
    ignore = (REPOSITORY / ".dockerignore").read_text().splitlines()
    assert "*" in ignore
    assert {line[1:] for line in ignore if line.startswith("!")} == copied
    for name in copied:
        assert (REPOSITORY / name).exists()


def test_the_example_of_scaled_settings_sets_what_compose_reads(compose: dict[str, Any]) -> None:
    lines = (REPOSITORY / "scale.env.example").read_text().splitlines()
    values = dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))
    read = set(re.findall(r"\$\{(\w+):-", (REPOSITORY / "docker-compose.yml").read_text()))
    assert set(values) <= read
    Settings(worker_queues=yaml.safe_load(values["MASS_WORKER_QUEUES"]))
    assert values["MASS_DATABASE_URL"].endswith("@postgres/mass")
    assert "postgres" in compose["services"]
