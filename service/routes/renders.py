"""Pictures of a finished hand in any pose, from any side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.access.gate import CallerDep
from service.access.keys import Caller
from service.jobs.model import JobKind
from service.jobs.schemas import JobPage, JobView, MotionRequest, job_view
from service.motions import canonical_motion
from service.pictures import MAX_SIDE, MIN_SIDE, Channel, PictureFormat, canonical_view
from service.problems import Kind, ProblemError, declared
from service.routes.jobs import Cursor, JobId, checked_cursor
from service.routes.submission import ACCEPTED, IDEMPOTENCY, IdempotencyKey
from service.services import Services, ServicesDep, not_modified
from service.submission import Wanted, fingerprint, spelled, submit

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
async def render_job(
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
    most = services.settings.max_render_pixels
    view = canonical_view(pose, camera, width, height, format, most, channel)
    artifact, part = await run_in_threadpool(_find, services, job_id, caller, hand)
    view = replace(view, hand=part.name if part.name in ("left", "right") else "")
    headers = {"ETag": view.etag(job_id, artifact), "Cache-Control": "private, no-cache"}
    if not_modified(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    avatar = part / "avatar.safetensors"
    # A link says nothing about who follows it: the takers of one hand's links are one owner.
    picture = await services.drawing.picture(job_id, artifact, avatar, view, caller.owner or job_id)
    return Response(picture, media_type=view.media_type, headers=headers)


@router.post(
    "/{job_id}/renders",
    status_code=202,
    responses={
        **ACCEPTED,
        **declared(
            Kind.REQUEST_INVALID,
            Kind.POSE_INVALID,
            Kind.CAMERA_INVALID,
            Kind.RENDER_TOO_LARGE,
            Kind.RENDER_NO_HAND,
            Kind.JOB_NOT_READY,
            Kind.JOB_NO_RESULT,
            Kind.QUOTA,
            *IDEMPOTENCY,
        ),
    },
)
async def create_render(
    job_id: JobId,
    request: Request,
    response: Response,
    services: ServicesDep,
    caller: CallerDep,
    body: MotionRequest | None = None,
    hand: Hand = None,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Render a motion, as a small job of its own: follow it as any job; its file is the asset `motion.mp4`
    or `motion.webp`. It is deleted with the job whose hand it shows, or by itself."""
    motion = canonical_motion(body or MotionRequest(), services.settings)

    def share(new_id: str) -> Wanted:
        artifact = services.avatar(job_id, caller)
        part = _folder(services.storage.artifact_path(job_id, artifact), hand)
        try:
            avatar = services.storage.share(part / "avatar.safetensors", new_id)
        except FileNotFoundError:
            raise ProblemError(Kind.JOB_NO_RESULT) from None
        mark = fingerprint(f"POST /jobs/{job_id}/renders", part.name, spelled(motion))
        return Wanted(new_id, motion, avatar, None, mark, kind=JobKind.RENDER, parent=job_id)

    async def receive(new_id: str) -> Wanted:
        return await run_in_threadpool(share, new_id)

    return job_view(await submit(services, request, response, caller, idempotency_key, receive))


@router.get("/{job_id}/renders", responses=declared(Kind.JOB_NOT_FOUND, Kind.REQUEST_INVALID))
def list_renders(
    job_id: JobId,
    services: ServicesDep,
    caller: CallerDep,
    limit: Annotated[int, Query(ge=1, le=100)] = 20,
    cursor: Cursor = None,
) -> JobPage:
    """The motions of this job's hand, newest first."""
    services.job(job_id, caller)
    jobs, following = services.store.page(limit, checked_cursor(cursor), caller.sees, parent=job_id)
    return JobPage(jobs=[job_view(job) for job in jobs], next=following)


def _find(services: Services, job_id: str, caller: Caller, hand: str | None) -> tuple[str, Path]:
    """The job's result and the folder of the hand in it. Raises ProblemError (404, 409)."""
    artifact = services.avatar(job_id, caller)
    return artifact, _folder(services.storage.published(job_id, artifact), hand)


def _folder(result: Path, hand: str | None) -> Path:
    """Where the files of the hand lie: in the result itself, or in the hand's own folder."""
    hands = [name for name in ("right", "left") if (result / name).is_dir()]
    if hand is not None and hand not in hands:
        detail = f"It has the {' and the '.join(hands)} hand." if hands else "It was not made for both hands."
        raise ProblemError(Kind.RENDER_NO_HAND, detail)
    return result / (hand or hands[0]) if hands else result
