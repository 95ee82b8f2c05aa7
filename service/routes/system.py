"""The service itself: alive, what it can do, what its errors mean."""

from __future__ import annotations

from importlib.metadata import version
from typing import Literal, get_args

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from service.access.gate import asks_for_keys
from service.pictures import MAX_SIDE, MIN_SIDE, POSE_VALUES, Channel, PictureFormat
from service.problems import Kind, ProblemError, declared
from service.pulse import live_workers
from service.readiness import check_all
from service.routes.uploads import VERSION
from service.services import ServicesDep
from service.storage import MOTIONS

router = APIRouter(tags=["service"])


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(BaseModel):
    """Every part is there."""

    status: Literal["ready"] = "ready"
    checks: list[str]


class Capabilities(BaseModel):
    """What this service accepts and makes."""

    version: str
    engine: str = Field(description="The engine's version; a result's report names the one that made it.")
    device: Literal["cpu", "cuda"] = Field(description="Where jobs that ask for no device are fitted.")
    needs_key: bool
    workers: int = Field(description="Workers alive now, as far as this process sees.")
    containers: list[str]
    max_upload_bytes: int
    max_video_seconds: float
    max_attempts: int
    tus: str = Field(description="The version of tus spoken at `/uploads`.")
    motions: list[str]
    max_motion_frames: int
    pictures: list[str]
    channels: list[str]
    min_render_side: int
    max_render_side: int
    max_render_pixels: int
    pose_values: int


class ProblemKind(BaseModel):
    """One of the errors the service answers with."""

    code: str
    status: int
    title: str
    advice: str


@router.get("/healthz")
def get_health() -> Health:
    """200 while the process answers. Whether it can work: `/readyz`."""
    return Health()


@router.get("/readyz", responses=declared(Kind.NOT_READY))
def get_readiness(services: ServicesDep) -> Readiness:
    """200 while database, broker, disk and at least one worker are there."""
    checks = check_all(services)
    wrong = [{"field": check.name, "message": check.trouble} for check in checks if check.trouble]
    if wrong:
        raise ProblemError(Kind.NOT_READY, errors=wrong, headers={"Retry-After": "5"})
    return Readiness(checks=[check.name for check in checks])


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {"description": "Prometheus text.", "content": {"text/plain": {"schema": {"type": "string"}}}},
        **declared(Kind.NOT_FOUND),
    },
)
def get_metrics(services: ServicesDep) -> Response:
    """Figures for Prometheus. Where keys are asked for, it needs one with the scope `admin`. With a port of
    their own (`MASS_METRICS_PORT`) they are not here."""
    if services.settings.metrics_port is not None:
        raise ProblemError(Kind.NOT_FOUND)
    return Response(services.metrics.text(), media_type=CONTENT_TYPE_LATEST)


@router.get("/capabilities")
def get_capabilities(services: ServicesDep) -> Capabilities:
    """Limits and formats."""
    settings = services.settings
    return Capabilities(
        version=version("mass-hand"),
        engine=version("mass-hand"),
        device="cuda" if settings.default_queue == "gpu" else "cpu",
        needs_key=asks_for_keys(settings.auth, settings.host),
        workers=len(live_workers(settings.data_dir)),
        containers=["mp4", "mov", "webm"],
        max_upload_bytes=settings.max_upload_bytes,
        max_video_seconds=settings.max_video_seconds,
        max_attempts=settings.max_attempts,
        tus=VERSION,
        motions=[name.partition(".")[2] for name in MOTIONS],
        max_motion_frames=settings.max_motion_frames,
        pictures=list(get_args(PictureFormat)),
        channels=list(get_args(Channel)),
        min_render_side=MIN_SIDE,
        max_render_side=MAX_SIDE,
        max_render_pixels=settings.max_render_pixels,
        pose_values=POSE_VALUES,
    )


@router.get("/problems/{code}", responses=declared(Kind.NOT_FOUND))
def get_problem_kind(code: str) -> ProblemKind:
    """What an error's `type` refers to."""
    for kind in Kind:
        if kind.code == code:
            return ProblemKind(code=kind.code, status=kind.status, title=kind.title, advice=kind.advice)
    raise ProblemError(Kind.NOT_FOUND)
