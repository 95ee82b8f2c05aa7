"""The directory an attempt works in, and what it takes over from the attempt before.

An engine saves its state in ``RUN/checkpoint``. The next attempt gets a copy of the whole directory under its
own name: the old one is renamed first, so that an engine still writing there (its worker stopped, its lease
gone) finds nothing where it looks, and then copied file by file, so that what it holds open is not shared.
"""

from __future__ import annotations

import logging
import shutil
import stat
import tarfile
from pathlib import Path

from service.jobs.leases import Claim
from service.storage import Storage
from worker.sandbox import SCRATCH

log = logging.getLogger(__name__)

#: Where an engine keeps what it needs to go on.
CHECKPOINT = "checkpoint"
#: Results of a finished attempt, not to be mistaken for those of the next one.
_RESULTS = frozenset({"avatar.safetensors", "report.json", "surfels.ply", "surfels-3dgs.ply", "assets.json"})


def prepare(storage: Storage, claim: Claim) -> tuple[Path, bool]:
    """Make the attempt's directory; returns it and whether there is a checkpoint in it to go on from.

    Everything left by earlier attempts is gone afterwards. The first attempt of a restarted job finds what
    was shared with it as if an attempt had left it. Raises OSError when the directory cannot be made.
    """
    run = storage.attempt_dir(claim.job_id, claim.artifact)
    earlier = [path for path in run.parent.iterdir() if path != run and has_checkpoint(path)]
    if earlier:
        _take_over(max(earlier, key=_age_of_checkpoint), run, claim.token)
    else:
        _load(storage, claim.job_id, run)
    storage.drop_attempts(claim.job_id, keep=claim.artifact)
    return run, has_checkpoint(run)


def has_checkpoint(run: Path) -> bool:
    """Whether an engine left something to go on from."""
    folder = run / CHECKPOINT
    return folder.is_dir() and not folder.is_symlink() and any(folder.iterdir())


def drop_checkpoint(run: Path) -> None:
    """Forget it: the engine has failed on it, so the next attempt begins at the beginning."""
    shutil.rmtree(run / CHECKPOINT, ignore_errors=True)


def _age_of_checkpoint(run: Path) -> float:
    return max(path.lstat().st_mtime for path in (run / CHECKPOINT, *(run / CHECKPOINT).iterdir()))


def _take_over(old: Path, run: Path, token: str) -> None:
    aside = old.with_name(f".taken-{token}")
    try:
        old.rename(aside)
        _copy(aside, run)
    except OSError as error:
        log.warning("the checkpoint could not be taken over (%s); starting from the beginning", error)
        _clear(run)


def _load(storage: Storage, job_id: str, run: Path) -> bool:
    """Take what another machine saved."""
    try:
        return storage.load_checkpoint(job_id, run / CHECKPOINT)
    except (OSError, tarfile.TarError) as error:
        log.warning("the saved checkpoint could not be fetched (%s)", error)
        _clear(run)
        return False


def _clear(run: Path) -> None:
    for path in run.iterdir():
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _copy(source: Path, target: Path) -> None:
    """Copy plain files and folders; an engine's output is not trusted, so links are left out."""
    for path in source.iterdir():
        mode = path.lstat().st_mode
        if stat.S_ISDIR(mode) and path.name != SCRATCH:
            (target / path.name).mkdir(mode=0o750)
            _copy(path, target / path.name)
        elif stat.S_ISREG(mode) and path.name not in _RESULTS:
            shutil.copy2(path, target / path.name, follow_symlinks=False)
