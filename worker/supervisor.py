"""One job from claim to end: start the engine, keep the lease, pass on progress, obey, and write the result.

Every write carries the fencing token of the claim. When the lease is lost, whoever has it now decides what
the job becomes: this worker stops its engine and writes nothing.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from service.jobs.housekeeping import purge_deleted
from service.jobs.leases import LOST_ADVICE, Claim, Heartbeat
from service.jobs.model import FINAL_STATES, JobKind
from service.jobs.store import JobStore
from service.logs import about, trace_of
from service.queue import JobQueue
from service.settings import Settings
from service.storage import Storage, missing_outputs
from worker.engine import EngineProcess, EngineProgress, UnknownOptionError, animate_command, fit_command
from worker.ladder import DEVICE_UNAVAILABLE, EXIT_OUT_OF_MEMORY, OUT_OF_MEMORY, Setting
from worker.run_directory import CHECKPOINT, drop_checkpoint, has_checkpoint, prepare
from worker.sandbox import Sandbox

log = logging.getLogger(__name__)

#: How often the supervisor looks up from waiting, and how often it asks whether the job was cancelled.
_TICK_SECONDS = 0.25
_CANCEL_SECONDS = 1.0
#: How long a cancelled engine, and one stopped by a shutdown, may take to end by itself.
_CANCEL_GRACE = 2.0
_SHUTDOWN_GRACE = 5.0

_EXIT_BAD_ARGUMENTS = 2
_EXIT_BAD_INPUT = 3


class Outcome(StrEnum):
    """How a worker's dealing with one message ended."""

    REFUSED = "refused"  # the worker is stopping, or its disk full: the job is left to others
    SKIPPED = "skipped"  # nothing to do: somebody else has the job, or it is over
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    RELEASED = "released"  # back in the queue
    LOST = "lost"  # the lease went to somebody else


class _Stop(StrEnum):
    """Why the watch over a running engine ended."""

    EXITED = "exited"
    CANCEL = "cancel"
    LOST = "lost"
    SHUTDOWN = "shutdown"
    TIMEOUT = "timeout"


class Lease:
    """Renews a claim in time and answers whether to go on. An unreachable database is waited for, until
    the lease must have run out."""

    def __init__(
        self, store: JobStore, claim: Claim, settings: Settings, since: float, clock: Callable[[], float]
    ) -> None:
        """``since``: the clock just before the claim was made, so that we never think it lasts longer."""
        self._store, self._claim, self._clock = store, claim, clock
        self._seconds, self._every = settings.lease_seconds, settings.heartbeat_seconds
        self._until = since + self._seconds
        self._next_beat = since + self._every
        self._next_look = since

    def check(self) -> Heartbeat:
        """Look for a cancellation every second and renew every ``heartbeat_seconds``."""
        now = self._clock()
        if now < min(self._next_look, self._next_beat):
            return Heartbeat.OK
        try:
            if now < self._next_beat:
                self._next_look = now + _CANCEL_SECONDS
                job = self._store.get(self._claim.job_id)
                if job is not None and not job.cancel_requested and job.token == self._claim.token:
                    return Heartbeat.OK
            return self.renew()
        except SQLAlchemyError as error:
            log.warning("job %s: database not reached (%s)", self._claim.job_id, type(error).__name__)
            self._next_look = self._next_beat = self._clock() + _CANCEL_SECONDS
            return Heartbeat.LOST if self._clock() >= self._until else Heartbeat.OK

    def renew(self) -> Heartbeat:
        """Renew now. Raises SQLAlchemyError when the database does not answer."""
        now = self._clock()
        answer = self._store.heartbeat(self._claim.job_id, self._claim.token, self._seconds)
        self._until, self._next_beat = now + self._seconds, now + self._every
        return answer


class Supervisor:
    """Deals with wake-up messages, one at a time per calling thread."""

    def __init__(
        self,
        settings: Settings,
        store: JobStore,
        storage: Storage,
        queue: JobQueue,
        stopping: threading.Event,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._store, self._storage, self._queue = settings, store, storage, queue
        self._stopping = stopping
        self._clock = clock
        self._sandbox = Sandbox(settings)

    def run(self, job_id: str) -> Outcome:
        """Do the job if it can be claimed. Raises only when the database cannot be reached."""
        if self._stopping.is_set():
            job = self._store.get(job_id)
            if job is not None:
                self._queue.publish(job_id, job.queue)
            return Outcome.REFUSED
        if not self._storage.has_room():
            # The row stays queued; the reconciler asks again after a pause, here or on a machine with room.
            log.error("job %s: not started, the disk is full", job_id)
            return Outcome.REFUSED
        since = self._clock()
        claim = self._store.claim(job_id, lease_seconds=self._settings.lease_seconds)
        if claim is None:
            return Outcome.SKIPPED
        with about(job=job_id, trace=trace_of(claim.traceparent)):
            return self._do(claim, Lease(self._store, claim, self._settings, since, self._clock))

    def _do(self, claim: Claim, lease: Lease) -> Outcome:
        job_id = claim.job_id
        log.info("job %s: attempt %d starts", job_id, claim.attempt)
        try:
            outcome = self._work(claim, lease)
        except SQLAlchemyError:
            # Nothing more can be written; the lease runs out and the reconciler takes the job back.
            log.exception("job %s: the database stopped answering", job_id)
            outcome = Outcome.LOST
        except Exception:
            log.exception("job %s: the worker failed", job_id)
            outcome = self._broken(claim, "worker.failed", "The worker could not run the engine.")
        log.info("job %s: attempt %d %s", job_id, claim.attempt, outcome)
        try:
            self._tidy(claim, outcome)
        except (OSError, SQLAlchemyError) as error:
            log.warning("job %s: leftovers remain for now (%s)", job_id, error)
        return outcome

    def _tidy(self, claim: Claim, outcome: Outcome) -> None:
        """Remove the directories nobody needs: a checkpoint is kept for the next attempt or a restart."""
        run = self._storage.artifact_path(claim.job_id, claim.artifact)
        if outcome is Outcome.SUCCEEDED:
            self._storage.drop_attempts(claim.job_id, keep=claim.artifact)
        elif outcome is Outcome.LOST:
            # Whoever has the job now may be taking this directory over; it goes once the job is over.
            job = self._store.get(claim.job_id)
            if job is None:
                self._storage.delete_job(claim.job_id)
            elif job.state in FINAL_STATES or not self._storage.has_room():
                shutil.rmtree(run, ignore_errors=True)
        elif not has_checkpoint(run):
            shutil.rmtree(run, ignore_errors=True)
            self._storage.drop_checkpoint(claim.job_id)
        elif outcome is not Outcome.RELEASED:
            self._storage.save_checkpoint(claim.job_id, run / CHECKPOINT)  # for a restart
        if outcome is Outcome.CANCELLED:
            purge_deleted(self._store, self._storage)  # DELETE of a running job ends as a cancellation

    def _work(self, claim: Claim, lease: Lease) -> Outcome:
        run, resumed = prepare(self._storage, claim)
        video = self._storage.fetch_source(claim.video, run)
        deadline = self._clock() + self._settings.job_timeout
        setting = Setting(claim.options)
        warnings: list[dict[str, str]] = []
        while True:
            try:
                command = self._command(claim, setting, video, run, resumed)
            except UnknownOptionError as error:
                return self._fail(claim, "options.invalid", f"The job has an {error}.", "Submit it without.")
            engine, stop, code = self._run_engine(claim, lease, command, video, run, deadline, warnings)
            match stop:
                case _Stop.LOST:
                    return Outcome.LOST
                case _Stop.CANCEL:
                    return self._cancelled(claim)
                case _Stop.SHUTDOWN:
                    return self._release(claim, refund=True)
                case _Stop.TIMEOUT:
                    return self._fail(
                        claim,
                        "engine.timeout",
                        f"The reconstruction did not finish within {self._settings.job_timeout:g} s.",
                        "Submit a shorter clip, or a lower preset.",
                    )
            if code == EXIT_OUT_OF_MEMORY and engine.failure and engine.failure.code == OUT_OF_MEMORY:
                smaller = setting.smaller(claim.kind)
                if smaller is None:
                    return self._out_of_memory(claim, setting, run)
                setting, resumed = smaller, has_checkpoint(run)
                warnings = [*engine.warnings, setting.warning()]
                self._tell(claim, [f"warning {w['code']}: {w['message']}" for w in warnings[-1:]], warnings)
                continue
            if resumed and (code != 0 or missing_outputs(run, claim.kind)):
                # It may be the checkpoint that breaks the engine: the next attempt begins anew.
                drop_checkpoint(run)
            outcome = self._conclude(claim, lease, engine, code, run)
            if outcome is Outcome.FAILED:
                drop_checkpoint(run)
            return outcome

    def _command(self, claim: Claim, setting: Setting, video: Path, run: Path, resumed: bool) -> list[str]:
        """What to start. Raises UnknownOptionError."""
        engine = self._settings.engine
        if claim.kind == JobKind.RENDER:
            return animate_command(engine, video, run, setting.options, device=setting.device)
        return fit_command(
            engine,
            video,
            run,
            setting.options,
            resume=resumed,
            # At a smaller setting what lies there is this attempt's own.
            from_stage=None if setting.changed else claim.from_stage,
            max_seconds=self._settings.max_video_seconds,
        )

    def _run_engine(
        self,
        claim: Claim,
        lease: Lease,
        command: list[str],
        video: Path,
        run: Path,
        deadline: float,
        warnings: list[dict[str, str]],
    ) -> tuple[EngineProcess, _Stop, int]:
        """Start it, watch it, end it: afterwards no process of it is left, nor anything it had on a device.

        ``warnings``: those the job has already.
        """
        self._sandbox.open(run, video)
        environment = self._sandbox.environment(run)
        if claim.traceparent is not None:
            environment["TRACEPARENT"] = claim.traceparent
        engine = EngineProcess(self._sandbox.command(command, run, video), environment, warnings)
        grace = 0.0
        try:
            stop = self._watch(claim, lease, engine, deadline)
            grace = {_Stop.CANCEL: _CANCEL_GRACE, _Stop.SHUTDOWN: _SHUTDOWN_GRACE}.get(stop, 0.0)
        finally:
            code = engine.stop(grace)
            self._sandbox.close(run)
            self._tell(claim, engine.new_lines(), engine.warnings)
        return engine, stop, code

    def _watch(self, claim: Claim, lease: Lease, engine: EngineProcess, deadline: float) -> _Stop:
        shown: EngineProgress | None = None
        while engine.wait(_TICK_SECONDS) is None:
            if self._stopping.is_set():
                return _Stop.SHUTDOWN
            if self._clock() > deadline:
                return _Stop.TIMEOUT
            answer = lease.check()
            if answer is not Heartbeat.OK:
                return _Stop.CANCEL if answer is Heartbeat.CANCEL else _Stop.LOST
            self._tell(claim, engine.new_lines(), engine.warnings)
            if engine.progress is not shown:
                shown = engine.progress
                self._show(claim, engine.progress)
        return _Stop.EXITED

    def _show(self, claim: Claim, progress: EngineProgress | None) -> None:
        if progress is None:
            return
        try:
            self._store.report_progress(
                claim.job_id,
                claim.token,
                progress.stage,
                progress.fraction,
                progress.time_left,
                progress.message,
            )
        except SQLAlchemyError as error:
            # Progress may be missed; the lease decides how long to go on without a database.
            log.warning("job %s: progress not written (%s)", claim.job_id, type(error).__name__)

    def _tell(self, claim: Claim, lines: list[str], warnings: list[dict[str, str]]) -> None:
        """Give the job's owner what was said."""
        if lines:
            try:
                self._store.log(claim.job_id, claim.token, lines)
                if warnings:
                    self._store.report_warnings(claim.job_id, claim.token, warnings)
            except SQLAlchemyError as error:
                log.warning("job %s: log not written (%s)", claim.job_id, type(error).__name__)

    def _out_of_memory(self, claim: Claim, setting: Setting, run: Path) -> Outcome:
        drop_checkpoint(run)
        tried = "".join(f", nor {words}" for words in setting.changed)
        return self._fail(
            claim,
            OUT_OF_MEMORY,
            f"The GPU's memory did not suffice as asked{tried}.",
            "Submit it with the device cpu, or a shorter or smaller video; whoever runs the service should "
            "see that no other program uses the worker's GPU.",
        )

    def _conclude(self, claim: Claim, lease: Lease, engine: EngineProcess, code: int, run: Path) -> Outcome:
        said = engine.failure
        if code == 0:
            missing = missing_outputs(run, claim.kind)
            if not missing:
                return self._succeed(claim, lease)
            log.error("job %s: the engine left no %s", claim.job_id, ", ".join(missing))
        elif code == _EXIT_BAD_ARGUMENTS:
            log.error("job %s: the engine refused its arguments: %s", claim.job_id, engine.tail)
            message = said.message if said else "The engine does not accept these options."
            # That this machine lacks a GPU is not the owner's doing.
            word = DEVICE_UNAVAILABLE if said and said.code == DEVICE_UNAVAILABLE else "options.invalid"
            return self._fail(claim, word, message, (said and said.advice) or "Submit with other options.")
        elif code == _EXIT_BAD_INPUT and said is not None and said.code:
            outcome = self._fail(claim, said.code, said.message, said.advice)
            if outcome is Outcome.FAILED:
                # No later attempt could use this video: nothing of it stays behind.
                self._storage.discard_upload(claim.job_id)
            return outcome
        else:
            log.error("job %s: the engine ended with %d: %s", claim.job_id, code, engine.tail)
        return self._broken(claim, "engine.crashed", f"The engine stopped unexpectedly ({_describe(code)}).")

    def _succeed(self, claim: Claim, lease: Lease) -> Outcome:
        answer = lease.renew()  # making the files durable takes a while
        if answer is Heartbeat.OK:
            self._storage.publish(claim.job_id, claim.artifact)
            if self._store.succeed(claim.job_id, claim.token, claim.artifact):
                return Outcome.SUCCEEDED
        return self._cancelled(claim)

    def _cancelled(self, claim: Claim) -> Outcome:
        ended = self._store.finish_cancel(claim.job_id, claim.token)
        return Outcome.CANCELLED if ended else Outcome.LOST

    def _fail(self, claim: Claim, code: str, message: str, advice: str) -> Outcome:
        ended = self._store.fail(claim.job_id, claim.token, code, message, advice)
        return Outcome.FAILED if ended else Outcome.LOST

    def _broken(self, claim: Claim, code: str, message: str) -> Outcome:
        """Another attempt, or the end when this was the last one."""
        full = not self._storage.has_room()
        if full:
            # At once: the database may need the room to write down what happened.
            shutil.rmtree(self._storage.artifact_path(claim.job_id, claim.artifact), ignore_errors=True)
        if claim.attempt < self._settings.max_attempts:
            return self._release(claim, refund=False)
        advice = LOST_ADVICE
        if full:
            code, message = "storage.full", "The disk of the worker filled up."
            advice = "Try again later, with a shorter clip; whoever runs the service should make room."
        return self._fail(claim, code, f"{message} It was tried {claim.attempt} times.", advice)

    def _release(self, claim: Claim, *, refund: bool) -> Outcome:
        self._save(claim)
        if not self._store.release(claim.job_id, claim.token, refund=refund):
            return Outcome.LOST
        # The row is queued and due: should the broker be away, a reconciler sends the message.
        if self._queue.publish(claim.job_id, claim.queue):
            self._store.mark_published(claim.job_id)
        return Outcome.RELEASED

    def _save(self, claim: Claim) -> None:
        """Before anyone else may start: let whoever does find the checkpoint, or none."""
        run = self._storage.artifact_path(claim.job_id, claim.artifact)
        try:
            if has_checkpoint(run):
                self._storage.save_checkpoint(claim.job_id, run / CHECKPOINT)
            else:
                self._storage.drop_checkpoint(claim.job_id)
        except OSError as error:
            log.warning("job %s: its checkpoint was not saved (%s)", claim.job_id, error)


def _describe(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
