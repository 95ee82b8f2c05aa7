"""``python -m benchmarks.render_load``: how fast a service draws pictures, alone and under several clients.

Starts the API on this machine with the real engine and one render process, gives it a finished job (the
built-in hand, or ``--avatar FILE``), and asks for pictures over HTTP, each of another pose: none comes
from the cache. Says the 50th, 90th and 99th percentiles in milliseconds.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import uvicorn

from service.app import create_app
from service.services import Services
from service.settings import Settings


def main() -> None:
    """Measure and print one JSON object a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--avatar", type=Path, help="an avatar.safetensors (default: the built-in hand)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--requests", type=int, default=100)
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--format", default="jpeg")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="mass-load-") as folder,
        _service(Path(folder)) as (url, services),
    ):
        job_id = _finished_job(services, options.avatar)
        with httpx.Client(base_url=url, timeout=120.0) as http:
            http.get(f"/jobs/{job_id}/render", params={"pose": "fist"}).raise_for_status()
        for clients in options.clients:
            took, refused, seconds = _load(url, job_id, clients, options)
            percentiles = {f"p{q}_ms": round(float(np.percentile(took, q)), 1) for q in (50, 90, 99)}
            rate = {"pictures_per_second": round(len(took) / seconds, 1), "refused": refused}
            print(json.dumps({"clients": clients, "pictures": len(took), **percentiles, **rate}), flush=True)


def _load(url: str, job_id: str, clients: int, options: argparse.Namespace) -> tuple[list[float], int, float]:
    """Milliseconds of each picture, how many requests were refused (503), and seconds in all."""
    barrier = threading.Barrier(clients)
    each = max(options.requests // clients, 1)

    def one(client: int) -> tuple[list[float], int]:
        took, refused = [], 0
        rng = np.random.default_rng(1000 * clients + client)
        with httpx.Client(base_url=url, timeout=120.0) as http:
            barrier.wait()
            for _ in range(each):
                pose = ",".join(f"{angle:.4f}" for angle in rng.uniform(-0.3, 0.3, 48))
                query = {
                    "pose": pose,
                    "width": options.size,
                    "height": options.size,
                    "format": options.format,
                }
                start = time.perf_counter()
                answer = http.get(f"/jobs/{job_id}/render", params=query)
                if answer.status_code == 503:
                    refused += 1
                    continue
                answer.raise_for_status()
                took.append(1000 * (time.perf_counter() - start))
        return took, refused

    start = time.perf_counter()
    with ThreadPoolExecutor(clients) as pool:
        results = [*pool.map(one, range(clients))]
    seconds = time.perf_counter() - start
    return [ms for took, _ in results for ms in took], sum(refused for _, refused in results), seconds


@contextmanager
def _service(folder: Path) -> Iterator[tuple[str, Services]]:
    app = create_app(Settings(data_dir=folder, min_free_bytes=0, render_queue=64))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning", timeout_graceful_shutdown=2))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.05)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}", app.state.services
    finally:
        server.should_exit = True
        thread.join(30.0)


def _finished_job(services: Services, avatar: Path | None) -> str:
    """A job as a worker leaves it."""
    job = services.store.create({}, "uploads/none/source")
    claim = services.store.claim(job.id)
    assert claim is not None
    run = services.storage.attempt_dir(job.id, claim.artifact)
    if avatar is None:
        from tests.engine.avatars import small_avatar

        small_avatar().save(run)
    else:
        shutil.copyfile(avatar, run / "avatar.safetensors")
    services.storage.publish(job.id, claim.artifact)
    services.store.succeed(job.id, claim.token, claim.artifact)
    return job.id


if __name__ == "__main__":
    main()
