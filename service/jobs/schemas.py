"""What goes in and out of the API about jobs."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.jobs.model import FINAL_STATES, Job, JobKind, JobState

_ID = "01a20643-3392-721a-b36b-68b7197560f0"
_EXAMPLE: dict[str, Any] = {
    "id": _ID,
    "kind": "fit",
    "parent": None,
    "state": "running",
    "stage": "fit",
    "fraction": 0.41,
    "time_left": 95.0,
    "message": "stage 2 at 640 px",
    "attempt": 1,
    "options": {
        "side": "auto",
        "preset": "auto",
        "seed": 0,
        "fov": None,
        "max_frames": None,
        "holdout": None,
    },
    "motion": None,
    "restarted_from": None,
    "video_bytes": 7340032,
    "created_at": "2026-11-23T10:00:00Z",
    "started_at": "2026-11-23T10:00:01Z",
    "finished_at": None,
    "error": None,
    "links": {
        "self": f"/jobs/{_ID}",
        "cancel": f"/jobs/{_ID}/cancel",
        "upload": None,
        "restart": None,
        "events": f"/jobs/{_ID}/events",
        "logs": f"/jobs/{_ID}/logs",
        "preview": f"/jobs/{_ID}/preview",
        "render": None,
        "renders": None,
        "assets": None,
    },
}


class JobOptions(BaseModel):
    """How to reconstruct; the names and meanings are those of the engine's command line."""

    model_config = ConfigDict(extra="forbid")

    side: Literal["auto", "left", "right", "both"] = Field(
        default="auto",
        description="Which hand to reconstruct; `both` makes an avatar of each hand of the person.",
    )
    preset: Literal["draft", "auto", "full"] = Field(
        default="auto", description="How much time to spend on quality."
    )
    seed: int = Field(default=0, ge=0, lt=2**31, description="Same seed, same machine: same result.")
    fov: float | None = Field(
        default=None,
        gt=10,
        lt=150,
        allow_inf_nan=False,
        description="Field of view across the longer image side, degrees; absent: the engine assumes one.",
    )
    max_frames: int | None = Field(
        default=None, ge=2, le=100_000, description="Use at most this many frames."
    )
    device: Literal["auto", "cpu", "cuda"] | None = Field(
        default=None, description="Where to compute; the job waits for a worker that has it."
    )
    holdout: int | None = Field(
        default=None,
        ge=2,
        le=1000,
        description="Keep every n-th frame out of the fit and measure quality on it.",
    )


class MotionRequest(BaseModel):
    """A moving hand."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["turntable", "poses"] = Field(
        default="turntable", description="Once around the first pose, or from each pose to the next."
    )
    poses: list[Annotated[str, Field(max_length=2000)]] = Field(
        default=["rest"],
        min_length=1,
        max_length=200,
        description="Poses as `render` takes them.",
        examples=[["rest", "fist", "spread"]],
    )
    between: int = Field(default=11, ge=0, le=120, description="Pictures put between two poses.")
    loop: bool = Field(default=True, description="Back to the first pose at the end.")
    seconds: float = Field(default=4.0, gt=0, le=30, allow_inf_nan=False, description="Of a turntable.")
    camera: str = Field(default="orbit:0,0", max_length=200, description="As `render` takes it.")
    width: int = Field(default=512, ge=16, le=2048)
    height: int = Field(default=512, ge=16, le=2048)
    fps: float = Field(default=30.0, ge=1, le=60, allow_inf_nan=False)
    format: Literal["mp4", "webp"] = Field(default="mp4", description="mp4 on white, webp with alpha.")


class UploadedJob(BaseModel):
    """A job of a video that comes, or came, through `POST /uploads`."""

    model_config = ConfigDict(extra="forbid")

    upload: str = Field(max_length=64, description="The id of the upload, which becomes the job's.")
    options: JobOptions = Field(default_factory=JobOptions)


class ErrorView(BaseModel):
    """Why a job failed."""

    code: str = Field(examples=["video.no_hand"])
    message: str
    advice: str
    stage: str | None = Field(description="What the engine was doing; null when no worker had it.")


class RestartRequest(BaseModel):
    """What to do differently this time; both may be left out."""

    model_config = ConfigDict(extra="forbid")

    from_stage: Literal["read", "track", "segment", "align", "convert", "fit", "evaluate"] | None = Field(
        default=None,
        description="Begin here if the first job left a checkpoint of what comes before, else as late as its "
        "checkpoints allow, which may be the beginning. Absent: from the beginning.",
    )
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Options to change (see `JobOptions`); null sets one back to its default.",
        examples=[{"preset": "full", "fov": None}],
    )


class WarningView(BaseModel):
    """Something the engine found worth a word; the result is there all the same."""

    code: str = Field(examples=["video.damaged"])
    message: str
    advice: str


class Links(BaseModel):
    """Where to go from here; absent what the job's state does not allow yet."""

    self: str
    cancel: str | None = None
    upload: str | None = None
    restart: str | None = None
    events: str
    logs: str
    preview: str
    render: str | None = None
    renders: str | None = None
    assets: str | None = None


class JobView(BaseModel):
    """One job."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    id: str
    kind: JobKind = Field(description="`fit`: an avatar of a video; `render`: a motion of an avatar.")
    parent: str | None = Field(description="Of a render: the job whose avatar moves.")
    state: JobState
    stage: str | None = Field(description="What the engine does now: read, track, segment, align, ...")
    fraction: float = Field(ge=0, le=1, description="Of the whole job; never falls within one attempt.")
    time_left: float | None = Field(description="Seconds, as the engine estimates it.")
    message: str
    attempt: int = Field(description="Which try this is; a try lost to a crash is repeated.")
    options: JobOptions | None = Field(description="Of a fit.")
    motion: MotionRequest | None = Field(description="Of a render.")
    restarted_from: str | None = Field(description="The job whose video this one uses again.")
    video_bytes: int | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    warnings: list[WarningView]
    error: ErrorView | None
    links: Links


class JobPage(BaseModel):
    """Some jobs, newest first."""

    jobs: list[JobView]
    next: str | None = Field(description="Pass as `cursor` for the page after this one; null on the last.")


class AssetView(BaseModel):
    """One file of a finished job."""

    name: str
    bytes: int
    sha256: str
    media_type: str
    href: str


class AssetList(BaseModel):
    """The files of a finished job."""

    assets: list[AssetView]


def job_view(job: Job) -> JobView:
    """The public side of a row."""
    path = f"/jobs/{job.id}"
    done = job.state == JobState.SUCCEEDED
    fits = job.kind == JobKind.FIT
    error = None
    if job.error_code is not None:
        error = ErrorView(
            code=job.error_code,
            message=job.error_message or "",
            advice=job.error_advice or "",
            stage=job.stage,
        )
    return JobView(
        id=job.id,
        kind=JobKind(job.kind),
        parent=job.parent,
        state=job.state,
        stage=job.stage,
        fraction=job.fraction,
        time_left=job.time_left,
        message=job.message,
        attempt=job.attempt,
        options=JobOptions.model_validate(job.options) if fits else None,
        motion=None if fits else MotionRequest.model_validate(job.options),
        restarted_from=job.restarted_from,
        video_bytes=job.video_bytes,
        created_at=_moment(job.created_at),
        started_at=None if job.started_at is None else _moment(job.started_at),
        finished_at=None if job.finished_at is None else _moment(job.finished_at),
        warnings=[WarningView.model_validate(warning) for warning in job.warnings],
        error=error,
        links=Links(
            self=path,
            upload=f"/uploads/{job.id}" if job.state == JobState.AWAITING_UPLOAD else None,
            cancel=None if job.state in FINAL_STATES else f"{path}/cancel",
            restart=f"{path}/restart" if fits and job.state in FINAL_STATES - {JobState.EXPIRED} else None,
            events=f"{path}/events",
            logs=f"{path}/logs",
            preview=f"{path}/preview",
            render=f"{path}/render" if done and fits else None,
            renders=f"{path}/renders" if done and fits else None,
            assets=f"{path}/assets" if done else None,
        ),
    )


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
