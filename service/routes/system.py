"""The service itself: alive, what it can do, what its errors mean."""

from __future__ import annotations

from importlib.metadata import version
from typing import Literal, get_args

from fastapi import APIRouter
from pydantic import BaseModel

from service.pictures import MAX_SIDE, MIN_SIDE, POSE_VALUES, Channel, PictureFormat
from service.problems import Kind, ProblemError, declared
from service.services import ServicesDep

router = APIRouter(tags=["service"])


class Health(BaseModel):
    """The process answers and its database does."""

    status: Literal["ok"] = "ok"


class Capabilities(BaseModel):
    """What this service accepts and makes."""

    version: str
    containers: list[str]
    max_upload_bytes: int
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
def get_health(services: ServicesDep) -> Health:
    """200 while the process and its database answer."""
    services.store.ping()
    return Health()


@router.get("/capabilities")
def get_capabilities(services: ServicesDep) -> Capabilities:
    """Limits and formats."""
    settings = services.settings
    return Capabilities(
        version=version("mass-hand"),
        containers=["mp4", "mov", "webm"],
        max_upload_bytes=settings.max_upload_bytes,
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
