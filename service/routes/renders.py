"""Pictures of a finished hand in any pose, from any side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from service.access.gate import CallerDep
from service.pictures import MAX_SIDE, MIN_SIDE, Channel, PictureFormat, canonical_view
from service.problems import Kind, ProblemError, declared
from service.routes.jobs import JobId
from service.services import ServicesDep, not_modified

router = APIRouter(prefix="/jobs", tags=["results"])

Hand = Annotated[
    Literal["left", "right"] | None,
    Query(description="Of a job for both hands, which; absent: the only one, or the right one."),
]
Side = Annotated[int, Query(ge=MIN_SIDE, le=MAX_SIDE, description="Pixels.")]


@router.get(
    "/{job_id}/render",
    response_class=Response,
    responses={
        200: {
            "description": "The picture. PNG and WebP have straight alpha; JPEG shows the hand on white.",
            "content": {
                f"image/{name}": {"schema": {"type": "string", "contentMediaType": f"image/{name}"}}
                for name in ("png", "jpeg", "webp")
            },
        },
        304: {"description": "Unchanged since the ETag sent."},
        **declared(
            Kind.JOB_NOT_FOUND,
            Kind.JOB_NOT_READY,
            Kind.JOB_NO_RESULT,
            Kind.REQUEST_INVALID,
            Kind.POSE_INVALID,
            Kind.CAMERA_INVALID,
            Kind.RENDER_TOO_LARGE,
            Kind.RENDER_NO_HAND,
            Kind.RENDER_REFUSED,
            Kind.RENDER_FAILED,
            Kind.RENDER_BUSY,
            Kind.RENDER_TIMEOUT,
        ),
    },
)
def render_job(
    job_id: JobId,
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    pose: Annotated[
        str,
        Query(
            max_length=2000,
            description="`rest`, `fist`, `point`, `pinch`, `spread`, `frame:N`, or 48 comma-separated angles "
            "in radians: the axis-angle of the wrist, then of the 15 joints.",
        ),
    ] = "rest",
    camera: Annotated[
        str,
        Query(
            max_length=200,
            description="`source` (the camera of the video), or `orbit:YAW,PITCH` around the hand, degrees, "
            "at a distance that fits it into the picture; `orbit:YAW,PITCH,DISTANCE` names it in metres.",
        ),
    ] = "orbit:0,0",
    hand: Hand = None,
    width: Side = 512,
    height: Side = 512,
    format: Annotated[PictureFormat, Query()] = "png",
    channel: Annotated[
        Channel,
        Query(
            description="What is shown. `rgb`; `alpha`: grey; `depth`: near bright, far dark, between the "
            "hand's nearest and farthest point; `normal`: x right, y up, z to the viewer as red, green, "
            "blue; `distortion`: where surfels lie apart along the ray, from black up to the hand's 99th "
            "percentile; `surfels`: the centres of the visible surfels as white disks."
        ),
    ] = "rgb",
) -> Response:
    """Render the hand. Repeated requests are answered from a cache; use `If-None-Match`."""
    artifact = services.artifact(job_id, caller)
    most = services.settings.max_render_pixels
    view = canonical_view(pose, camera, width, height, format, most, channel)
    part = _folder(services.storage.published(job_id, artifact), hand)
    view = replace(view, hand=part.name if part.name in ("left", "right") else "")
    headers = {"ETag": view.etag(job_id, artifact), "Cache-Control": "private, no-cache"}
    if not_modified(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    picture = services.pictures.get(job_id, artifact, view)
    if picture is None:
        picture = services.pool.render(part / "avatar.safetensors", view)
        services.pictures.put(job_id, artifact, view, picture)
    return Response(picture, media_type=view.media_type, headers=headers)


def _folder(result: Path, hand: str | None) -> Path:
    """Where the files of the hand lie: in the result itself, or in the hand's own folder."""
    hands = [name for name in ("right", "left") if (result / name).is_dir()]
    if hand is not None and hand not in hands:
        detail = f"It has the {' and the '.join(hands)} hand." if hands else "It was not made for both hands."
        raise ProblemError(Kind.RENDER_NO_HAND, detail)
    return result / (hand or hands[0]) if hands else result
