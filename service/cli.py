"""``mass``: run the service on this machine, or talk to one.

Exit codes: 0 done, 1 the service failed or could not be reached, 2 bad arguments, 3 the job failed, 130
interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.client import DEFAULT_URL, AssetInfo, JobInfo, MassClient, ServiceError
from service.keys_command import add_parser as add_keys_parser
from service.logs import configure as configure_logs
from service.processes import hide_memory
from service.progress import FollowBar, transfer_bar

_FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
        return code
    except ServiceError as error:
        return _complain(error.message, error.advice, error.code)
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        return _complain(f"{name}{error.strerror or error}", "Check the path and its permissions.")
    except KeyboardInterrupt:
        return 130


def _complain(message: str, advice: str, code: str | None = None) -> int:
    print(f"mass: {message}" + (f" [{code}]" if code else ""), file=sys.stderr)
    if advice:
        print(f"      {advice}", file=sys.stderr)
    return 1


# The service


def _serve(options: argparse.Namespace) -> int:
    from service.embedded import BrokerError
    from service.serve import ServeError, serve

    hide_memory()
    settings = _settings(options)
    if settings is None:
        return 2
    configure_logs("serve", settings.log_format)
    try:
        return serve(settings, options.workers)
    except (ServeError, BrokerError) as error:
        return _complain(error.message, error.advice)


def _api(options: argparse.Namespace) -> int:
    import uvicorn

    from service.app import create_app

    hide_memory()
    settings = _settings(options)
    if settings is None:
        return 2
    configure_logs("api", settings.log_format)
    # Open event streams and downloads may not hold up a stop for longer than this.
    config = uvicorn.Config(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=10,
    )
    sockets = None if options.fd is None else [socket.socket(fileno=options.fd)]
    uvicorn.Server(config).run(sockets=sockets)
    return 0


def _settings(options: argparse.Namespace) -> Any:
    """The environment's settings under the command line's; None, with a message, when they are wrong."""
    from pydantic import ValidationError
    from pydantic_settings import SettingsError

    from service.settings import Settings

    names = ("host", "port", "data_dir")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    try:
        return Settings(**given)
    except ValidationError as error:
        for fault in error.errors():
            name = "_".join(map(str, fault["loc"]))
            print(f"mass: MASS_{name.upper()}: {fault['msg']}", file=sys.stderr)
    except SettingsError as error:
        print(f"mass: {error}", file=sys.stderr)
    return None


# Its users


def _submit(options: argparse.Namespace) -> int:
    wanted = dict(options.option)
    with MassClient(options.url) as client:
        with transfer_bar(f"uploading {options.video.name}") as tell:
            job = client.submit(options.video, wanted, tell)
        print(job.id, flush=True)
        return _follow(client, job.id) if options.wait else 0


def _watch(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        return _follow(client, options.id)


def _follow(client: MassClient, job_id: str) -> int:
    with FollowBar() as bar:
        job = client.wait(job_id, bar.show)
    return _verdict(job)


def _verdict(job: JobInfo) -> int:
    if job.state == "succeeded":
        return 0
    if job.error is None:
        _complain(f"The job was {job.state}.", "")
    else:
        _complain(job.error.message, job.error.advice, job.error.code)
    return 3


def _status(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        _print_job(client.job(options.id))
    return 0


def _list(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        for job in client.jobs():
            _print_job(job)
    return 0


def _print_job(job: JobInfo) -> None:
    words = [job.id, f"{job.state:9}", f"{job.fraction:4.0%}", job.stage or "", job.created_at]
    if job.error is not None:
        words.append(f"[{job.error.code}] {job.error.message}")
    print("  ".join(words).rstrip())


def _render(options: argparse.Namespace) -> int:
    width, height = options.size
    with MassClient(options.url) as client:
        image_format = _FORMATS[options.out.suffix.lower()]
        picture = client.render(
            options.id, options.pose, options.camera, width, height, image_format, options.channel
        )
    options.out.write_bytes(picture)
    print(options.out)
    return 0


def _animate(options: argparse.Namespace) -> int:
    width, height = options.size
    motion = {
        "kind": "turntable" if options.poses is None else "poses",
        "poses": (options.poses or "rest").split(";"),
        "camera": options.camera,
        "width": width,
        "height": height,
        "fps": options.fps,
        "seconds": options.seconds,
        "format": options.out.suffix.lower().removeprefix("."),
    }
    with MassClient(options.url) as client:
        job = client.animate(options.id, motion)
        with FollowBar() as bar:
            job = client.wait(job.id, bar.show)
        if job.state != "succeeded":
            return _verdict(job)
        with tempfile.TemporaryDirectory(dir=options.out.parent) as folder:
            for asset in client.assets(job.id):
                _fetch(client, job.id, asset, Path(folder)).replace(options.out)
        client.delete(job.id)
    print(options.out)
    return 0


def _restart(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        job = client.restart(options.id, dict(options.option), options.from_stage)
        print(job.id, flush=True)
        return _follow(client, job.id) if options.wait else 0


def _logs(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        for line in client.logs(options.id):
            print(line)
    return 0


def _download(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        assets = client.assets(options.id)
        chosen = [asset for asset in assets if options.name in (None, asset.name)]
        if not chosen:
            names = ", ".join(asset.name for asset in assets)
            return _complain(f"The job has no file {options.name}.", f"It has {names}.", "asset.not_found")
        for asset in chosen:
            print(_fetch(client, options.id, asset, options.out), flush=True)
    return 0


def _fetch(client: MassClient, job_id: str, asset: AssetInfo, folder: Path) -> Path:
    with transfer_bar(f"downloading {asset.name}") as tell:
        return client.download(job_id, asset, folder, tell)


def _cancel(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        _print_job(client.cancel(options.id))
    return 0


def _delete(options: argparse.Namespace) -> int:
    with MassClient(options.url) as client:
        client.delete(options.id)
    return 0


# Arguments


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="mass", description="A phone video in, a posable hand out.")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Any, text: str, job: bool = False) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(run=run)
        if run not in (_serve, _api):
            url = os.environ.get("MASS_URL", DEFAULT_URL)
            added.add_argument("--url", default=url, help="the service (default: $MASS_URL or %(default)s)")
        if job:
            added.add_argument("id", help="the job")
        return added

    for name, run, text in (
        ("serve", _serve, "Run broker, API and workers on this machine."),
        ("api", _api, "Run the API alone; broker and workers run elsewhere."),
    ):
        added = command(name, run, text)
        added.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
        added.add_argument("--port", type=int, help="port to listen on, 0 for any (default: 8000)")
        added.add_argument("--data-dir", type=Path, help="where everything is kept (default: ./data)")
        if run is _serve:
            added.add_argument("--workers", type=_count, default=1, help="jobs at a time (default: 1)")
        else:
            added.add_argument("--fd", type=int, help=argparse.SUPPRESS)

    submit = command("submit", _submit, "Upload a video and create its job; prints the job's id.")
    submit.add_argument("video", type=Path)
    submit.add_argument(
        "--option",
        "-o",
        type=_option,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="e.g. side=left",
    )
    submit.add_argument("--wait", "-w", action="store_true", help="follow the job to its end")
    command("watch", _watch, "Follow a job to its end.", job=True)
    command("status", _status, "Show a job.", job=True)
    command("list", _list, "Show all jobs, newest first.")
    render = command("render", _render, "Render a finished hand.", job=True)
    render.add_argument("--pose", default="rest", help="rest, fist, frame:12, ... (default: rest)")
    render.add_argument("--camera", default="source", help="source or orbit:YAW,PITCH,DISTANCE")
    render.add_argument("--size", type=_size, default=(512, 512), metavar="WxH")
    render.add_argument(
        "--channel", default="rgb", metavar="rgb|alpha|depth|normal|distortion|surfels", help="what to show"
    )
    render.add_argument("--out", type=_picture, required=True, help="a .png, .jpg or .webp file")
    animate = command("animate", _animate, "Render a motion of a finished hand.", job=True)
    animate.add_argument("--poses", metavar="A;B;...", help="from pose to pose (default: a turn around rest)")
    animate.add_argument("--camera", default="orbit:0,0", help="orbit:YAW,PITCH[,DISTANCE]")
    animate.add_argument("--size", type=_size, default=(512, 512), metavar="WxH")
    animate.add_argument("--fps", type=float, default=30.0)
    animate.add_argument("--seconds", type=float, default=4.0, help="of a turn (default: 4)")
    animate.add_argument("--out", type=_motion, required=True, help="a .mp4 or .webp file")
    restart = command("restart", _restart, "Make a new job of a finished one's video.", job=True)
    restart.add_argument(
        "--option", "-o", type=_option, action="append", default=[], metavar="NAME=VALUE", help="to change"
    )
    restart.add_argument("--from-stage", help="begin here if there is a checkpoint")
    restart.add_argument("--wait", "-w", action="store_true", help="follow the job to its end")
    command("logs", _logs, "Show what the engine said.", job=True)
    download = command("download", _download, "Download the files of a finished job.", job=True)
    download.add_argument("name", nargs="?", help="one file (default: all)")
    download.add_argument("--out", type=Path, default=Path(), help="folder (default: here)")
    command("cancel", _cancel, "Stop a job.", job=True)
    add_keys_parser(commands)
    command("delete", _delete, "Remove a job and everything of it.", job=True)
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError("a number from 1 to 64")
    return int(text)


def _option(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT")
    return int(width), int(height)


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in _FORMATS:
        raise argparse.ArgumentTypeError(f"{text!r} does not end in one of {', '.join(_FORMATS)}")
    return path


def _motion(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in (".mp4", ".webp"):
        raise argparse.ArgumentTypeError(f"{text!r} does not end in .mp4 or .webp")
    return path


if __name__ == "__main__":
    sys.exit(main())
