"""What motion is asked for, checked before a job is made of it."""

from __future__ import annotations

from service.jobs.schemas import MotionRequest
from service.pictures import canonical_view
from service.problems import Kind, ProblemError
from service.settings import Settings


def canonical_motion(wish: MotionRequest, settings: Settings) -> MotionRequest:
    """The motion with poses and camera in their one spelling. Raises ProblemError (422)."""
    most = settings.max_render_pixels
    views = [canonical_view(pose, wish.camera, wish.width, wish.height, "png", most) for pose in wish.poses]
    if wish.kind == "turntable" and views[0].camera == "source":
        raise ProblemError(Kind.CAMERA_INVALID, "A turntable needs an orbit.")
    frames = round(wish.seconds * wish.fps) if wish.kind == "turntable" else len(views) * (wish.between + 1)
    if frames > settings.max_motion_frames:
        detail = f"That makes about {frames} pictures; {settings.max_motion_frames} are allowed."
        raise ProblemError(Kind.RENDER_TOO_LARGE, detail)
    canonical = {"poses": [view.pose for view in views], "camera": views[0].camera}
    return wish.model_copy(update=canonical)
