"""Configuration: one object made from the environment (``MASS_*``) and handed to whoever needs it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

GIB = 1024**3

_QUEUES: tuple[Literal["cpu", "gpu"], ...] = ("cpu", "gpu")


class Settings(BaseSettings):
    """Everything that can be set. Times are seconds, sizes bytes. There is no module-level instance."""

    model_config = SettingsConfigDict(env_prefix="MASS_", extra="ignore")

    data_dir: Path = Path("data")
    #: SQLAlchemy URL of the job database; empty means a SQLite file in ``data_dir``.
    database_url: str = ""
    #: Where complete files are kept for other machines to see (service/blobs.py): empty for ``data_dir``
    #: itself, ``file:///shared/folder`` or ``s3://bucket/prefix?endpoint=https://host``.
    storage_url: str = ""
    #: Broker; None means the embedded one (see ``broker_url`` in service/queue.py).
    redis_url: str | None = None
    #: Where a job goes that does not say which device it needs, and what a worker here takes.
    default_queue: Literal["cpu", "gpu"] = "cpu"
    worker_queues: list[Literal["cpu", "gpu"]] = Field(default_factory=lambda: [*_QUEUES], min_length=1)

    #: Lines for people, or one JSON object a line with the job and the trace it is about.
    log_format: Literal["text", "json"] = "text"

    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    #: A port for /metrics alone, which the public one then does not have; 0 takes a free one (the log names
    #: it). No key is asked for there, so it is for the network of whoever watches.
    metrics_port: int | None = Field(default=None, ge=0, le=65535)
    metrics_host: str = "127.0.0.1"
    #: Host headers answered to, besides loopback names and ``host``. "*" accepts any.
    allowed_hosts: list[str] = Field(default_factory=list)

    #: Whether keys are asked for: "auto" does so everywhere but on a loopback ``host``.
    auth: Literal["auto", "keys", "open"] = "auto"
    #: Signs links. Empty: one made in the data directory; machines that share jobs must share it.
    secret: SecretStr = SecretStr("")
    #: What one owner of keys may have; 0 is no limit. Minutes: of work, on the jobs of the last 24 hours.
    quota_jobs: int = Field(default=20, ge=0)
    quota_bytes: int = Field(default=20 * GIB, ge=0)
    quota_minutes: float = Field(default=600.0, ge=0)

    #: Requests a second that one owner of keys, and one address, may send in the long run (429 beyond); 0 is
    #: no limit. Far above what the page, the client and a film of pictures need. An address of this machine
    #: is not limited: a proxy there must say whom it speaks for (X-Forwarded-For).
    rate_owner: float = Field(default=100.0, ge=0)
    rate_address: float = Field(default=200.0, ge=0)
    #: How many seconds' worth of requests may come at once.
    rate_burst_seconds: float = Field(default=10.0, gt=0)

    max_upload_bytes: int = Field(default=2 * GIB, gt=0)
    max_video_seconds: float = Field(default=600.0, gt=0)
    #: Below this much free space no upload is accepted (507).
    min_free_bytes: int = Field(default=GIB, ge=0)
    #: How long a resumable upload is kept after its last byte, and how many unfinished an owner may have.
    upload_seconds: float = Field(default=24 * 3600.0, gt=0)
    max_open_uploads: int = Field(default=10, ge=0)
    #: An upload without a job that nobody wrote to for this long is removed.
    orphan_upload_seconds: float = Field(default=3600.0, gt=0)

    #: Retention, counted from a job's end; 0 keeps for ever. The video of a job that is over, the checkpoint
    #: of one that did not succeed, and the job itself with its results.
    keep_video_seconds: float = Field(default=30 * 86400.0, ge=0)
    keep_checkpoint_seconds: float = Field(default=86400.0, ge=0)
    keep_job_seconds: float = Field(default=0.0, ge=0)
    #: Let webhooks go to http and private addresses: for receivers beside the service.
    webhook_private: bool = False

    lease_seconds: float = Field(default=60.0, gt=0)
    heartbeat_seconds: float = Field(default=10.0, gt=0)
    max_attempts: int = Field(default=3, ge=1)
    reconcile_seconds: float = Field(default=10.0, gt=0)
    republish_min_seconds: float = Field(default=60.0, gt=0)
    republish_max_seconds: float = Field(default=600.0, gt=0)
    job_timeout: float = Field(default=2 * 3600.0, gt=0)

    #: Event streams one owner may have open in one API process.
    max_streams: int = Field(default=50, ge=1)

    render_workers: int = Field(default=1, ge=1)
    render_timeout: float = Field(default=10.0, gt=0)
    #: The first picture of a job loads the avatar (and, in a fresh process, the engine itself).
    render_load_timeout: float = Field(default=60.0, gt=0)
    #: Requests that may wait for a render process; one more is answered 503.
    render_queue: int = Field(default=16, ge=0)
    render_warm_avatars: int = Field(default=4, ge=1)
    render_cache_bytes: int = Field(default=64 * 1024**2, ge=0)
    max_render_pixels: int = Field(default=2048 * 2048, gt=0)

    max_motion_frames: int = Field(default=900, gt=0)

    #: The engine's command line; tests put another program here.
    engine_command: list[str] | None = None

    #: "require": a worker that cannot shut the engine in as it should does not start; "best" says so and
    #: goes on.
    sandbox: Literal["best", "require"] = "best"
    #: The user that the engine becomes where the worker is root.
    engine_user: str = "nobody"
    #: Its address space (0: no limit; a GPU's driver needs that), and the largest file it may write.
    engine_memory_bytes: int = Field(default=24 * GIB, ge=0)
    engine_file_bytes: int = Field(default=4 * GIB, gt=0)
    #: Further folders it may read and write, for instance one with weights of its own.
    engine_paths: list[Path] = Field(default_factory=list)

    @field_validator("data_dir")
    @classmethod
    def _absolute(cls, value: Path) -> Path:
        return value.expanduser().absolute()

    @property
    def database(self) -> str:
        """The SQLAlchemy URL in force."""
        return self.database_url or f"sqlite:///{self.data_dir / 'mass.sqlite3'}"

    @property
    def engine(self) -> list[str]:
        """The command that starts the engine, without its arguments."""
        return self.engine_command or [sys.executable, "-m", "mass_engine"]
