"""Files of jobs on a local disk. Every name in a path is chosen here or comes from a fixed list.

    uploads/<job>/source            the video (``source.part`` until it is complete)
    jobs/<job>/<attempt>-<token>/   one attempt's output; the row names the one that counts

An attempt's directory is written by one worker only, and becomes the job's result when the row says so.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from service.jobs.model import JobKind, is_job_id
from service.settings import Settings

#: Assets that may be served, with their media types; and the pattern of preview pictures.
ASSET_TYPES: dict[str, str] = {
    "avatar.safetensors": "application/octet-stream",
    "report.json": "application/json",
    "tracks.json": "application/json",
    "surfels.ply": "application/octet-stream",
    "motion.mp4": "video/mp4",
    "motion.webp": "image/webp",
}
#: A job for both hands has the files of each in a folder of its own.
_HAND = re.compile(r"(?:left|right)/")
_PREVIEW = re.compile(r"previews/[A-Za-z0-9][A-Za-z0-9_-]{0,63}\.(png|jpg|webp)")
MOTIONS = ("motion.mp4", "motion.webp")
#: Without these an attempt has not finished.
OUTPUTS = ("avatar.safetensors", "report.json", "surfels.ply")
#: What GET /jobs/{id}/preview shows: the result, or what the engine puts there while it works.
_LATEST = ("previews/pose-rest.png", "previews/live.jpg")
_MAX_PREVIEW = 4 * 1024**2
_PREVIEW_TYPES = {"png": "image/png", "jpg": "image/jpeg", "webp": "image/webp"}
_ARTIFACT = re.compile(r"[0-9]{1,6}-[0-9a-zA-Z]{1,64}")
#: The list of a result's assets, written last.
MANIFEST = "assets.json"
#: Every media type an asset can have.
MEDIA_TYPES = frozenset({*ASSET_TYPES.values(), *_PREVIEW_TYPES.values()})


@dataclass(frozen=True)
class Asset:
    """One downloadable file of a finished job."""

    name: str
    bytes: int
    sha256: str
    media_type: str


def media_type(name: str) -> str | None:
    """The media type of an asset that may be served; None for every other name."""
    name = _HAND.sub("", name, count=1) if _HAND.match(name) else name
    if _PREVIEW.fullmatch(name):
        return _PREVIEW_TYPES[name.rsplit(".", 1)[1]]
    return ASSET_TYPES.get(name)


class Storage:
    """The data directory. Wrong ids or names raise ValueError: they are bugs, not user errors."""

    def __init__(self, data_dir: Path, min_free_bytes: int = 0) -> None:
        self.root = data_dir
        self._min_free = min_free_bytes
        self._uploads = data_dir / "uploads"
        self._jobs = data_dir / "jobs"
        for folder in (self._uploads, self._jobs):
            # Others may pass through but not look around: an engine under another user has to get in.
            folder.mkdir(parents=True, exist_ok=True, mode=0o751)

    def free_bytes(self) -> int:
        """Bytes an unprivileged process may still write."""
        return shutil.disk_usage(self.root).free

    def has_room(self, incoming: int = 0) -> bool:
        """Whether ``incoming`` bytes fit and leave the reserve untouched."""
        return self.free_bytes() - incoming >= self._min_free

    # Uploads

    def begin_upload(self, job_id: str) -> Path:
        """Create the job's upload directory; returns the file to write."""
        folder = self._uploads / _checked(job_id)
        folder.mkdir(mode=0o750)
        return folder / "source.part"

    def upload_part(self, job_id: str) -> Path:
        """The file that :meth:`begin_upload` named."""
        return self._uploads / _checked(job_id) / "source.part"

    def finish_upload(self, job_id: str) -> str:
        """Make the written file durable and give it its name; returns the reference kept in the row."""
        part = self._uploads / _checked(job_id) / "source.part"
        _fsync(part)
        source = part.with_name("source")
        part.rename(source)
        _fsync(source.parent)
        _fsync(self._uploads)
        return str(source.relative_to(self.root))

    def discard_upload(self, job_id: str) -> None:
        """Forget an upload, complete or not."""
        shutil.rmtree(self._uploads / _checked(job_id), ignore_errors=True)

    def share(self, source: Path, job_id: str) -> str:
        """Give a job a file of another one, as if it had been uploaded; returns the reference.

        Each has a name of its own for the same bytes: removing one leaves the other. Raises
        FileNotFoundError when the file has been removed.
        """
        part = self.begin_upload(job_id)
        try:
            os.link(source, part)
        except FileNotFoundError:
            self.discard_upload(job_id)
            raise
        except OSError:  # a file system without links
            shutil.copyfile(source, part)
        return self.finish_upload(job_id)

    def share_checkpoint(self, job_id: str, new_id: str) -> bool:
        """Give a job the latest checkpoint another one left, where its first attempt looks for one.

        The engine keeps it in ``checkpoint`` of an attempt's directory. False when there is none.
        """
        folders = [path for path in (self._jobs / _checked(job_id)).glob("*/checkpoint") if path.is_dir()]
        if not folders:
            return False
        latest = max(folders, key=lambda path: path.stat().st_mtime)
        target = self.attempt_dir(new_id, "0-restart") / "checkpoint"
        shutil.copytree(latest, target, symlinks=True, ignore=_only_plain)
        return True

    def source(self, reference: str) -> Path:
        """The video a row refers to (``Job.video``)."""
        path = self.root / reference
        if path.parent.parent != self._uploads or path.name != "source" or not is_job_id(path.parent.name):
            raise ValueError(f"not an upload: {reference!r}")
        return path

    def fetch_source(self, reference: str, run: Path) -> Path:  # noqa: ARG002
        """The video a row refers to, as a file that the attempt in ``run`` may read."""
        return self.source(reference)

    def drop_video(self, job_id: str) -> None:
        """Remove a job's video and nothing else. Raises OSError when it could not be removed."""
        _remove(self._uploads / _checked(job_id))

    def idle_uploads(self, older_than: float) -> Iterator[str]:
        """Ids of upload directories nobody wrote to for ``older_than`` seconds."""
        limit = time.time() - older_than
        for folder in self._uploads.iterdir():
            times = [entry.stat().st_mtime for entry in (folder, *folder.glob("*")) if entry.exists()]
            if is_job_id(folder.name) and max(times, default=0.0) < limit:
                yield folder.name

    # Results

    def attempt_dir(self, job_id: str, artifact: str) -> Path:
        """Create and return the directory for one attempt's output (``Claim.artifact``)."""
        path = self._artifact(job_id, artifact)
        path.mkdir(parents=True, exist_ok=True, mode=0o750)
        return path

    def artifact_path(self, job_id: str, artifact: str) -> Path:
        """The directory of a published result."""
        return self._artifact(job_id, artifact)

    def publish(self, job_id: str, artifact: str) -> list[Asset]:
        """Hash the files, write the list of assets and make all of it durable.

        Call before the row is flipped with ``JobStore.succeed``. Links and unknown names are left out.
        """
        folder = self._artifact(job_id, artifact)
        assets = []
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder).as_posix()
            kind = media_type(name)
            if kind is not None and stat.S_ISREG(path.lstat().st_mode):
                assets.append(Asset(name, path.stat().st_size, _sha256(path), kind))
                _fsync(path)
        manifest = folder / MANIFEST
        manifest.write_text(json.dumps([asdict(asset) for asset in assets]))
        folders = sorted((p for p in folder.rglob("*") if p.is_dir() and not p.is_symlink()), reverse=True)
        for path in (manifest, *folders, folder, folder.parent):
            _fsync(path)
        _fsync(self._jobs)
        return assets

    def assets(self, job_id: str, artifact: str) -> list[Asset]:
        """What :meth:`publish` listed."""
        manifest = self._artifact(job_id, artifact) / MANIFEST
        return [Asset(**entry) for entry in json.loads(manifest.read_text())]

    def open_asset(self, job_id: str, artifact: str, name: str) -> tuple[Asset, Path] | None:
        """An asset and its file; None for a name that was not published or is not a plain file now."""
        if media_type(name) is None:
            return None
        found = next((asset for asset in self.assets(job_id, artifact) if asset.name == name), None)
        folder = self._artifact(job_id, artifact)
        path = folder / name
        linked = any(parent.is_symlink() for parent in path.parents if parent.is_relative_to(folder))
        if found is None or linked or not stat.S_ISREG(path.lstat().st_mode):
            return None
        return found, path

    def preview(self, job_id: str, artifact: str) -> tuple[bytes, str] | None:
        """The latest picture of an attempt, finished or not, and its media type; None when there is none."""
        folder = self._artifact(job_id, artifact)
        for name in _LATEST:
            for path in (folder / name, folder / "right" / name, folder / "left" / name):
                try:
                    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
                except OSError:
                    continue
                with os.fdopen(descriptor, "rb") as file:
                    picture = file.read(_MAX_PREVIEW)
                if picture:
                    return picture, _PREVIEW_TYPES[name.rpartition(".")[2]]
        return None

    def published(self, job_id: str, artifact: str) -> Path:
        """The directory of a published result, with all of its files in it."""
        return self._artifact(job_id, artifact)

    def save_checkpoint(self, job_id: str, folder: Path) -> None:
        """Keep an interrupted engine's state for another machine; on a disk that all share it is kept."""

    def load_checkpoint(self, job_id: str, folder: Path) -> bool:  # noqa: ARG002
        """Fetch what another machine kept; False when there is nothing but what lies here."""
        return False

    def drop_checkpoint(self, job_id: str) -> None:
        """Forget what was kept."""

    def local_jobs(self, older_than: float) -> list[str]:
        """Ids of the jobs with a directory here, last changed more than ``older_than`` seconds ago."""
        limit = time.time() - older_than
        found = []
        for folder in self._jobs.iterdir():
            with contextlib.suppress(FileNotFoundError):
                if is_job_id(folder.name) and folder.stat().st_mtime < limit:
                    found.append(folder.name)
        return sorted(found)

    def drop_local(self, job_id: str) -> None:
        """Remove a job's directory on this machine. Raises OSError when something could not be removed."""
        _remove(self._jobs / _checked(job_id))

    def attempts(self, job_id: str) -> list[Path]:
        """The directories of the job's attempts, whatever became of them."""
        folder = self._jobs / _checked(job_id)
        return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []

    def drop_attempts(self, job_id: str, keep: str | None = None) -> None:
        """Remove the output of every attempt except ``keep``."""
        folder = self._jobs / _checked(job_id)
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name != keep:
                shutil.rmtree(path, ignore_errors=True)

    def delete_job(self, job_id: str) -> None:
        """Remove every byte of the job. Raises OSError when something could not be removed."""
        for folder in (self._uploads / _checked(job_id), self._jobs / job_id):
            _remove(folder)

    def _artifact(self, job_id: str, artifact: str) -> Path:
        if _ARTIFACT.fullmatch(artifact) is None:
            raise ValueError(f"not an artifact: {artifact!r}")
        return self._jobs / _checked(job_id) / artifact


def missing_outputs(folder: Path, kind: str = JobKind.FIT) -> list[str]:
    """What a finished attempt in ``folder`` lacks: its files, or those of each hand it made."""
    if kind == JobKind.RENDER:
        return [] if any((folder / name).is_file() for name in MOTIONS) else ["motion"]
    hands = [name for name in ("left", "right") if (folder / name).is_dir()]
    needed = [f"{hand}/{name}" for hand in hands for name in OUTPUTS] or list(OUTPUTS)
    return [name for name in (*needed, "report.json") if not (folder / name).is_file()]


def _only_plain(folder: str, names: list[str]) -> list[str]:
    """Names to leave out of a copy: an engine's output is not trusted, so links and the like stay behind."""
    modes = {name: os.lstat(os.path.join(folder, name)).st_mode for name in names}
    return [name for name, mode in modes.items() if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))]


def create_storage(settings: Settings) -> Storage:
    """The storage of ``settings``. Raises BlobError for a ``storage_url`` of no known kind."""
    if settings.storage_url:
        from service.blobs import open_blobs
        from service.object_storage import ObjectStorage

        return ObjectStorage(settings.data_dir, open_blobs(settings.storage_url), settings.min_free_bytes)
    return Storage(settings.data_dir, settings.min_free_bytes)


def _checked(job_id: str) -> str:
    if not is_job_id(job_id):
        raise ValueError(f"not a job id: {job_id!r}")
    return job_id


def _remove(folder: Path) -> None:
    """Remove a tree whatever rights an engine left its folders. Raises OSError when something remains."""

    def again(_function: Callable[..., Any], path: str, _: Any) -> None:
        if not os.path.lexists(path):
            return
        with contextlib.suppress(OSError):
            os.chmod(os.path.dirname(path), 0o700)
            if not os.path.islink(path):
                os.chmod(path, 0o700)
        if os.path.isdir(path) and not os.path.islink(path):
            shutil.rmtree(path)
        else:
            os.unlink(path)

    if folder.exists():
        shutil.rmtree(folder, onerror=again)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
