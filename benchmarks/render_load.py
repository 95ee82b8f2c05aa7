"""``python -m benchmarks.render_load``: how fast a service draws pictures, for one client and for several.

Starts ``mass api`` with the real engine and one render process, gives it a finished job (the built-in hand,
or ``--avatar FILE``), and asks for pictures over HTTP, each of another pose: none comes from the cache. A
client asks again as soon as it is answered. Says the 50th, 90th and 99th percentiles in milliseconds, and the
processor time that each part took for a picture.

``--render-core N`` gives the render process that core and everything else the core of ``--other-core``;
without, all of it runs where this program may (``taskset -c 0 python -m ...``: everything shares one core).
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import psutil

from service.jobs.store import create_store
from service.processes import launch, stop_group
from service.settings import Settings
from service.storage import create_storage

_START_SECONDS = 120.0


@dataclass
class Answers:
    """``took``: milliseconds of each picture; how many requests were refused (503); seconds in all."""

    took: list[float]
    refused: int
    seconds: float


def main() -> None:
    """Measure and print one JSON object a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--avatar", type=Path, help="an avatar.safetensors (default: the built-in hand)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--requests", type=int, default=400, help="pictures of each number of clients")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--format", default="jpeg")
    parser.add_argument("--render-core", type=int, help="the core of the render process")
    parser.add_argument("--other-core", type=int, help="the core of the API and of the clients")
    options = parser.parse_args()
    if options.other_core is not None:
        os.sched_setaffinity(0, {options.other_core})
    with tempfile.TemporaryDirectory(prefix="mass-load-") as folder:
        job_id = _finished_job(Path(folder), options.avatar)
        with _service(Path(folder)) as (api, port):
            renderer = _renderer(api)
            if options.render_core is not None:
                _pin(renderer, options.render_core)
            _load(port, job_id, 1, 8, options)  # warm
            for clients in options.clients:
                parts = {"renderer": renderer, "api": api, "client": psutil.Process()}
                before = {name: _busy(process) for name, process in parts.items()}
                answers = _load(port, job_id, clients, options.requests, options)
                spent = {name: _busy(process) - before[name] for name, process in parts.items()}
                print(json.dumps(_summary(clients, answers, spent)), flush=True)


def _summary(clients: int, answers: Answers, spent: dict[str, float]) -> dict[str, object]:
    count = len(answers.took)
    percentiles = {f"p{q}_ms": round(float(np.percentile(answers.took, q)), 1) for q in (50, 90, 99)}
    return {
        "clients": clients,
        "pictures": count,
        **percentiles,
        "pictures_per_second": round(count / answers.seconds, 1),
        "refused": answers.refused,
        "cpu_ms_a_picture": {name: round(1000 * seconds / count, 1) for name, seconds in spent.items()},
    }


def _load(port: int, job_id: str, clients: int, requests: int, options: argparse.Namespace) -> Answers:
    barrier = threading.Barrier(clients)

    def one(client: int) -> tuple[list[float], int]:
        took, refused = [], 0
        rng = np.random.default_rng([clients, client])
        poses = rng.uniform(-0.3, 0.3, (max(requests // clients, 1), 48))
        paths = [_path(job_id, pose.tolist(), options) for pose in poses]
        # Small and quick: what a client costs is not what is measured here.
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=600.0)
        barrier.wait()
        for path in paths:
            start = time.perf_counter()
            connection.request("GET", path)
            answer = connection.getresponse()
            picture = answer.read()
            if answer.status == 503:
                refused += 1
                continue
            if answer.status != 200:
                raise RuntimeError(f"{answer.status}: {picture[:500]!r}")
            took.append(1000 * (time.perf_counter() - start))
        connection.close()
        return took, refused

    start = time.perf_counter()
    with ThreadPoolExecutor(clients) as pool:
        results = [*pool.map(one, range(clients))]
    seconds = time.perf_counter() - start
    return Answers([ms for took, _ in results for ms in took], sum(lost for _, lost in results), seconds)


def _path(job_id: str, pose: list[float], options: argparse.Namespace) -> str:
    query = {
        "pose": ",".join(f"{angle:.4f}" for angle in pose),
        "width": options.size,
        "height": options.size,
        "format": options.format,
    }
    return f"/jobs/{job_id}/render?{urlencode(query)}"


@contextmanager
def _service(data_dir: Path) -> Iterator[tuple[psutil.Process, int]]:
    """``mass api`` on a free port."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("MASS_")}
    # On a busy machine the figures say so, rather than that pictures were given up.
    patience = {"MASS_RENDER_LOAD_TIMEOUT": "600", "MASS_RENDER_TIMEOUT": "60"}
    environment = {**kept, **patience, "MASS_DATA_DIR": str(data_dir), "MASS_MIN_FREE_BYTES": "0"}
    log = data_dir / "api.log"
    with socket.create_server(("127.0.0.1", 0), backlog=64) as listener, log.open("wb") as output:
        port: int = listener.getsockname()[1]
        descriptor = listener.fileno()
        command = [sys.executable, "-m", "service.cli", "api", "--fd", str(descriptor)]
        process = launch(
            command, env=environment, stdout=output, stderr=subprocess.STDOUT, pass_fds=[descriptor]
        )
    try:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_START_SECONDS)
        connection.request("GET", "/healthz")  # the socket listens: the request waits there
        if connection.getresponse().status != 200:
            raise RuntimeError(log.read_text())
        connection.close()
        yield psutil.Process(process.pid), port
    finally:
        stop_group(process, 10.0)


def _renderer(api: psutil.Process) -> psutil.Process:
    """The API's render process."""
    (found,) = (child for child in api.children() if "spawn_main" in " ".join(child.cmdline()))
    return found


def _pin(process: psutil.Process, core: int) -> None:
    for thread in process.threads():
        os.sched_setaffinity(thread.id, {core})


def _busy(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _finished_job(data_dir: Path, avatar: Path | None) -> str:
    """A job as a worker leaves it."""
    settings = Settings(data_dir=data_dir)
    store, storage = create_store(settings), create_storage(settings)
    job = store.create({}, "uploads/none/source")
    claim = store.claim(job.id)
    assert claim is not None
    run = storage.attempt_dir(job.id, claim.artifact)
    if avatar is None:
        from tests.engine.avatars import small_avatar

        small_avatar().save(run)
    else:
        shutil.copyfile(avatar, run / "avatar.safetensors")
    storage.publish(job.id, claim.artifact)
    store.succeed(job.id, claim.token, claim.artifact)
    store.close()
    return job.id


if __name__ == "__main__":
    main()
