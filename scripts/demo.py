"""One job through the service, from a video to renders and assets; `make demo` runs it."""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import trimesh

from service.client import JobInfo, MassClient, ServiceError
from service.progress import FollowBar

POSES = ("rest", "fist", "point")
CAMERAS = (("front", "orbit:0,0"), ("side", "orbit:50,10"))


def main() -> int:
    """Run the demo; the exit code says whether every step worked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, help="a phone video of one hand; without it a clip is made")
    parser.add_argument("--out", type=Path, default=Path("demo-output"))
    parser.add_argument("--holdout", type=int, default=8)
    parser.add_argument("--preset", default="auto")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    video = arguments.video
    if video is None:
        video = out / "demo-clip.mp4"
        print(f"making a clip: {video}")
        subprocess.run([sys.executable, "-m", "mass_engine.evaluation.demo_clip", str(video)], check=True)
    elif not video.is_file():
        print(f"demo: there is no file {video}", file=sys.stderr)
        return 2
    data = Path(tempfile.mkdtemp(prefix="mass-demo-"))
    port = _free_port()
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port), "--data-dir", str(data)]
    with (out / "service.log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            with MassClient(f"http://127.0.0.1:{port}") as client:
                _wait_ready(client, server)
                print(f"service on http://127.0.0.1:{port}")
                return _run_job(
                    client, video, out, {"holdout": arguments.holdout, "preset": arguments.preset}
                )
        except ServiceError as error:
            print(f"demo: {error.code}: {error}; see {out / 'service.log'}", file=sys.stderr)
            return 1
        finally:
            server.send_signal(signal.SIGTERM)
            try:
                server.wait(60)
            except subprocess.TimeoutExpired:
                server.kill()
            shutil.rmtree(data, ignore_errors=True)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_ready(client: MassClient, server: subprocess.Popen[bytes]) -> None:
    """Until the service answers; raises ServiceError when it ends or takes longer than a minute."""
    deadline = time.monotonic() + 60
    while True:
        try:
            client.jobs().__next__()
            return
        except StopIteration:
            return
        except ServiceError:
            if server.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _run_job(client: MassClient, video: Path, out: Path, options: dict[str, object]) -> int:
    started = time.monotonic()
    job = client.submit(video, options)
    print(f"job {job.id}")
    with FollowBar() as bar:
        job = client.wait(job.id, bar.show)
    if job.state != "succeeded":
        _explain(job)
        return 1
    print(f"reconstructed in {time.monotonic() - started:.0f} s")
    for pose in POSES:
        for name, camera in CAMERAS:
            path = out / f"{pose}-{name}.png"
            path.write_bytes(client.render(job.id, pose, camera))
            print(f"  {path}")
    for asset in client.assets(job.id):
        client.download(job.id, asset, out)
    cloud = trimesh.load(out / "surfels.ply")
    print(f"  {out / 'surfels.ply'}: {len(cloud.vertices)} surfels, loaded with trimesh")
    report = json.loads((out / "report.json").read_text())
    for name, value in report["metrics"].items():
        shown = "not computed" if value is None else f"{value:.3f}"
        print(f"  {report['scored_frames']['kind']} {name}: {shown}")
    return 0


def _explain(job: JobInfo) -> None:
    error = job.error
    text = f"{error.code}: {error.message} {error.advice}" if error else job.state
    print(f"demo: the job did not succeed: {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
