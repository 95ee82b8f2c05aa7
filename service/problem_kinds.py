"""Every error that the service answers with, in one table."""

from __future__ import annotations

from enum import Enum


class Kind(Enum):
    """Every error the service answers with: code, status, title, advice. The codes are part of the API."""

    REQUEST_MALFORMED = (
        "request.malformed",
        400,
        "The request cannot be read",
        "Check how the body is encoded.",
    )
    REQUEST_HOST = (
        "request.host",
        403,
        "The Host header is not one this service answers to",
        "Use the service's own address, or have the name added to MASS_ALLOWED_HOSTS.",
    )
    REQUEST_ORIGIN = (
        "request.origin",
        403,
        "Another site's page sent this request",
        "Send changes from the service's own page or from a program.",
    )
    ACCESS_KEY = (
        "access.key",
        401,
        "This needs a key",
        "Send `Authorization: Bearer <key>`; `mass keys create` makes one.",
    )
    ACCESS_SCOPE = (
        "access.scope",
        403,
        "The key does not allow this",
        "Use a key with the scope that `detail` names.",
    )
    ACCESS_LINK = (
        "access.link",
        403,
        "The link has run out or was changed",
        "Ask for a new one with POST /jobs/{id}/links.",
    )
    QUOTA = (
        "quota.exceeded",
        429,
        "You have as much as you may have",
        "Wait the seconds in Retry-After, or delete finished jobs.",
    )
    RATE = (
        "rate.exceeded",
        429,
        "You ask too often",
        "Wait the seconds in Retry-After; follow a job by its events, or poll it once a second.",
    )
    NOT_FOUND = ("request.not_found", 404, "There is nothing at this path", "See /docs for the paths.")
    METHOD = (
        "request.method_not_allowed",
        405,
        "This path does not take that method",
        "See /docs for the methods of each path.",
    )
    REQUEST_MEDIA_TYPE = (
        "request.media_type",
        415,
        "The body is not a form",
        "Send multipart/form-data with the video in the field `video`.",
    )
    REQUEST_TOO_LARGE = (
        "request.too_large",
        413,
        "The body is too long",
        "Send less; only videos may be long, see POST /jobs and POST /uploads.",
    )
    REQUEST_INVALID = (
        "request.invalid",
        422,
        "A parameter is missing or wrong",
        "Correct the parameters listed under `errors`.",
    )
    HTTP = ("request.refused", 400, "The request was refused", "See /docs for what the service accepts.")
    INTERNAL = (
        "service.internal",
        500,
        "The service failed",
        "Try again; if it stays, report it with the time of the request.",
    )

    NOT_READY = (
        "service.not_ready",
        503,
        "The service cannot do all of its work",
        "See `errors` for the parts in trouble; jobs that were accepted are safe.",
    )

    UPLOAD_INCOMPLETE = (
        "upload.incomplete",
        400,
        "The upload ended early",
        "Send the whole file again; nothing of the broken upload was kept.",
    )
    UPLOAD_STALLED = (
        "upload.stalled",
        408,
        "The request stopped in the middle",
        "Send it again over a better connection.",
    )
    UPLOAD_TOO_LARGE = (
        "upload.too_large",
        413,
        "The upload is too large",
        "Send a shorter or smaller video; /capabilities names the limit.",
    )
    UPLOAD_NOT_FOUND = (
        "upload.not_found",
        404,
        "There is no such upload",
        "Begin a new one with POST /uploads; unfinished ones are kept until Upload-Expires.",
    )
    UPLOAD_VERSION = (
        "upload.version",
        412,
        "This version of tus is not spoken here",
        "Send the header `Tus-Resumable: 1.0.0`.",
    )
    UPLOAD_HEADERS = (
        "upload.headers",
        400,
        "A header of the upload is missing or wrong",
        "Correct the header that `detail` names; OPTIONS /uploads says what is offered.",
    )
    UPLOAD_MEDIA_TYPE = (
        "upload.media_type",
        415,
        "The body is not part of an upload",
        "Send it as application/offset+octet-stream.",
    )
    UPLOAD_OFFSET = (
        "upload.offset",
        409,
        "That is not where the upload stands",
        "Ask with HEAD for the Upload-Offset and go on from there.",
    )
    UPLOAD_LOCKED = (
        "upload.locked",
        423,
        "Another request is writing to this upload",
        "Try again after the seconds in Retry-After.",
    )
    UPLOAD_CHECKSUM = (
        "upload.checksum",
        460,
        "The bytes do not match their checksum",
        "Send this part again; nothing of it was kept.",
    )
    UPLOAD_USED = (
        "upload.used",
        409,
        "A job has been made of this upload already",
        "Use POST /jobs/{id}/restart to make another of the same video.",
    )
    STORAGE_FULL = (
        "storage.full",
        507,
        "The service has no room for this upload",
        "Delete finished jobs or try again later.",
    )
    VIDEO_MISSING = (
        "video.missing",
        422,
        "The form has no video",
        "Put the file into the form field `video`.",
    )
    VIDEO_EMPTY = ("video.empty", 422, "The video is empty", "Check the file: it has no bytes.")
    VIDEO_CONTAINER = (
        "video.unsupported_container",
        415,
        "This is not an MP4, MOV or WebM file",
        "Upload the video as the phone recorded it, or convert it to MP4.",
    )
    OPTIONS_INVALID = (
        "options.invalid",
        422,
        "The options are wrong",
        "Correct the options listed under `errors`.",
    )

    JOB_NOT_FOUND = (
        "job.not_found",
        404,
        "There is no such job",
        "Check the id; a deleted job is gone for good.",
    )
    JOB_NOT_READY = (
        "job.not_ready",
        409,
        "The job has not finished",
        "Wait until its state is `succeeded`.",
    )
    JOB_NO_RESULT = (
        "job.no_result",
        409,
        "The job ended without a result",
        "See the job's `error` for why, and submit another video.",
    )
    JOB_FINISHED = (
        "job.finished",
        409,
        "The job is over already",
        "There is nothing to cancel; DELETE removes it.",
    )
    JOB_UNFINISHED = (
        "job.unfinished",
        409,
        "The job is not over yet",
        "Cancel it first, or wait for its end.",
    )
    JOB_NO_VIDEO = (
        "job.no_video",
        409,
        "The job's video is no longer here",
        "Submit the video again.",
    )
    IDEMPOTENCY_IN_PROGRESS = (
        "idempotency.in_progress",
        409,
        "The same request is being answered now",
        "Wait for its answer, or send it again after the seconds in Retry-After.",
    )
    IDEMPOTENCY_MISMATCH = (
        "idempotency.mismatch",
        422,
        "This Idempotency-Key came with another request before",
        "Use a new key for each new request.",
    )
    PREVIEW_NONE = (
        "preview.none",
        404,
        "There is no preview yet",
        "The first one comes when the engine has begun to colour the hand.",
    )
    STREAMS = (
        "events.too_many",
        429,
        "You have too many event streams open",
        "Close one, or poll GET /jobs/{id} with If-None-Match.",
    )
    ASSET_NOT_FOUND = (
        "asset.not_found",
        404,
        "The job has no such asset",
        "The job's list of assets has the names.",
    )
    ASSET_RANGE = (
        "asset.range",
        416,
        "That range lies outside the file",
        "Ask for bytes within the size the asset list gives.",
    )

    WEBHOOK_NOT_FOUND = ("webhook.not_found", 404, "There is no such webhook", "GET /webhooks lists yours.")
    WEBHOOK_URL = (
        "webhook.url",
        422,
        "Nothing can be sent to this address",
        "Use an https address that everybody can reach.",
    )

    POSE_INVALID = (
        "pose.invalid",
        422,
        "The pose is not one",
        "Use a name such as `fist`, `frame:N`, or 48 comma-separated angles in radians.",
    )
    CAMERA_INVALID = (
        "camera.invalid",
        422,
        "The camera is not one",
        "Use `source`, or `orbit:YAW,PITCH` in degrees, with `,DISTANCE` in metres if you like.",
    )
    RENDER_TOO_LARGE = (
        "render.too_large",
        422,
        "The picture would be too large",
        "Ask for fewer pixels; /capabilities names the limit.",
    )
    RENDER_NO_HAND = (
        "render.no_hand",
        404,
        "The job has no such hand",
        "Leave `hand` out, or submit the video with the option `side` set to `both`.",
    )
    RENDER_REFUSED = ("render.refused", 422, "The engine refused the request", "Change the pose or camera.")
    RENDER_FAILED = (
        "render.failed",
        500,
        "The picture could not be made",
        "Try another pose or camera; if it stays, submit the video again.",
    )
    RENDER_BUSY = (
        "render.busy",
        503,
        "Too many pictures are being made",
        "Try again after the seconds in Retry-After.",
    )
    RENDER_TIMEOUT = (
        "render.timeout",
        503,
        "The picture took too long",
        "Ask for a smaller picture, or try again after the seconds in Retry-After.",
    )

    def __init__(self, code: str, status: int, title: str, advice: str) -> None:
        self.code = code
        self.status = status
        self.title = title
        self.advice = advice
