"""Files of jobs where several machines have to see them: an object store, with the local disk in front.

Whatever is complete goes to the store under the names it has on disk: ``uploads/<job>/source``,
``jobs/<job>/<attempt>-<token>/<asset>``, and the list of assets last, which makes a result whole or absent.
A worker's checkpoint goes there as well, so that another machine can go on from it. Locally lie uploads that
still grow, attempts that still run, and copies of results that were asked for here; housekeeping removes the
copies of jobs that are gone.
"""

from __future__ import annotations

import logging
import shutil
import tarfile
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from service.blobs import BlobError, BlobMissingError, BlobStore
from service.jobs.model import is_job_id
from service.storage import MANIFEST, Asset, Storage

log = logging.getLogger(__name__)

#: How often the store is asked for uploads that nobody wanted.
_LIST_SECONDS = 3600.0
_CHECKPOINT = "checkpoint.tar"


class ObjectStorage(Storage):
    """A Storage whose complete files are in ``blobs``. Raises BlobError (an OSError) when that fails."""

    def __init__(self, data_dir: Path, blobs: BlobStore, min_free_bytes: int = 0) -> None:
        super().__init__(data_dir, min_free_bytes)
        self._blobs = blobs
        self._list_at = 0.0

    # Uploads

    def finish_upload(self, job_id: str) -> str:
        """As on disk; the video is in the store when this returns, and no longer here."""
        reference = super().finish_upload(job_id)
        self._blobs.put(reference, self.source(reference))
        super().discard_upload(job_id)
        return reference

    def discard_upload(self, job_id: str) -> None:
        """Forget it here and in the store."""
        super().discard_upload(job_id)
        try:
            self._blobs.delete(f"uploads/{job_id}/")
        except BlobError as error:
            log.warning("upload %s: not yet removed from the store (%s)", job_id, error)

    def share(self, source: Path, job_id: str) -> str:
        """Give a job a file of another one, wherever that is."""
        part = self.begin_upload(job_id)
        try:
            if source.is_file():
                shutil.copyfile(source, part)
            else:
                self._blobs.get(source.relative_to(self.root).as_posix(), part)
        except BlobMissingError as error:
            super().discard_upload(job_id)
            raise FileNotFoundError(str(source)) from error
        return self.finish_upload(job_id)

    def share_checkpoint(self, job_id: str, new_id: str) -> bool:
        """Give a job the latest checkpoint another one left, where every worker finds it."""
        with tempfile.TemporaryDirectory(prefix=".pack-", dir=self.root / "jobs") as scratch:
            packed = Path(scratch) / _CHECKPOINT
            try:
                self._blobs.get(f"jobs/{job_id}/{_CHECKPOINT}.d/{_CHECKPOINT}", packed)
            except BlobMissingError:
                return False
            self._blobs.put(f"jobs/{new_id}/{_CHECKPOINT}.d/{_CHECKPOINT}", packed)
        return True

    def fetch_source(self, reference: str, run: Path) -> Path:
        """A copy in the attempt's scratch folder, which no other attempt touches."""
        self.source(reference)  # checks the reference
        folder = run / "tmp"
        folder.mkdir(mode=0o700, exist_ok=True)
        self._blobs.get(reference, folder / "source")
        return folder / "source"

    def idle_uploads(self, older_than: float) -> Iterator[str]:
        """Those here; now and then those in the store, too."""
        yield from super().idle_uploads(older_than)
        now = time.monotonic()
        if now >= self._list_at:
            self._list_at = now + min(_LIST_SECONDS, older_than)
            limit = time.time() - older_than
            for blob in self._blobs.listing("uploads/"):
                job_id = blob.key.split("/")[1]
                if is_job_id(job_id) and blob.modified < limit:
                    yield job_id

    # Results

    def publish(self, job_id: str, artifact: str) -> list[Asset]:
        """As on disk, then into the store, the list of assets last."""
        assets = super().publish(job_id, artifact)
        folder = self.artifact_path(job_id, artifact)
        for name in (*(asset.name for asset in assets), MANIFEST):
            self._blobs.put(f"jobs/{job_id}/{artifact}/{name}", folder / name)
        self._blobs.delete(f"jobs/{job_id}/{_CHECKPOINT}.d/")
        return assets

    def assets(self, job_id: str, artifact: str) -> list[Asset]:
        """What was published, wherever that was."""
        self._fetch(job_id, artifact, MANIFEST)
        return super().assets(job_id, artifact)

    def open_asset(self, job_id: str, artifact: str, name: str) -> tuple[Asset, Path] | None:
        """An asset and a local copy of it."""
        if any(asset.name == name for asset in self.assets(job_id, artifact)):
            self._fetch(job_id, artifact, name)
        return super().open_asset(job_id, artifact, name)

    def published(self, job_id: str, artifact: str) -> Path:
        """A directory with local copies of all of it."""
        for asset in self.assets(job_id, artifact):
            self._fetch(job_id, artifact, asset.name)
        return self.artifact_path(job_id, artifact)

    def _fetch(self, job_id: str, artifact: str, name: str) -> None:
        path = self.artifact_path(job_id, artifact) / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
            self._blobs.get(f"jobs/{job_id}/{artifact}/{name}", path)

    # Checkpoints

    def save_checkpoint(self, job_id: str, folder: Path) -> None:
        """Put the folder where every machine finds it."""
        with tempfile.TemporaryDirectory(prefix=".pack-", dir=self.root / "jobs") as scratch:
            packed = Path(scratch) / _CHECKPOINT
            with tarfile.open(packed, "w") as archive:
                archive.add(folder, arcname=".", filter=_plain)
            self._blobs.put(f"jobs/{job_id}/{_CHECKPOINT}.d/{_CHECKPOINT}", packed)

    def load_checkpoint(self, job_id: str, folder: Path) -> bool:
        """Fetch what another machine saved; False when there is nothing."""
        with tempfile.TemporaryDirectory(prefix=".pack-", dir=self.root / "jobs") as scratch:
            packed = Path(scratch) / _CHECKPOINT
            try:
                self._blobs.get(f"jobs/{job_id}/{_CHECKPOINT}.d/{_CHECKPOINT}", packed)
            except BlobMissingError:
                return False
            folder.mkdir(mode=0o750, exist_ok=True)
            with tarfile.open(packed) as archive:
                # An engine wrote it: nothing may land outside of the folder, and no link in it.
                archive.extractall(folder, members=filter(tarfile.TarInfo.isreg, archive), filter="data")
        return True

    def drop_checkpoint(self, job_id: str) -> None:
        """Forget it."""
        self._blobs.delete(f"jobs/{job_id}/{_CHECKPOINT}.d/")

    # The end

    def delete_job(self, job_id: str) -> None:
        """Remove every byte here and in the store; other machines' copies go with their next sweep."""
        super().delete_job(job_id)
        self._blobs.delete(f"uploads/{job_id}/")
        self._blobs.delete(f"jobs/{job_id}/")

    def drop_video(self, job_id: str) -> None:
        """Remove the source alone."""
        super().drop_video(job_id)
        self._blobs.delete(f"uploads/{job_id}/")


def _plain(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
    if not (member.isreg() or member.isdir()):
        return None
    member.uid = member.gid = 0
    member.uname = member.gname = ""
    return member
