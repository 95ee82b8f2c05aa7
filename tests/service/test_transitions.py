"""Whatever anybody calls in whatever order, jobs move only as the table of transitions says."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from service.jobs.leases import Heartbeat
from service.jobs.model import FINAL_STATES, HELD_STATES, TRANSITIONS, Job, JobState, sources
from service.jobs.store import Cancel, create_store
from service.settings import Settings

MAX_ATTEMPTS = 3
LEASE = 60.0


def test_the_table_is_closed_and_its_ends_are_ends() -> None:
    assert set(TRANSITIONS) == set(JobState)
    assert {"succeeded", "failed", "cancelled", "expired"} == FINAL_STATES
    for state, after in TRANSITIONS.items():
        for target in after:
            assert state in sources(target)
    reached = {JobState.AWAITING_UPLOAD}
    while more := {t for s in reached for t in TRANSITIONS[s]} - reached:
        reached |= more
    assert reached == set(JobState)


class JobLife(RuleBasedStateMachine):
    """One job, any number of workers with fresh and stale tokens, a user, a reconciler and a clock."""

    @initialize(awaits=st.booleans())
    def begin(self, awaits: bool) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.now = 1_000.0
        settings = Settings(data_dir=Path(self.folder.name), max_attempts=MAX_ATTEMPTS)
        self.store = create_store(settings, lambda: self.now)
        self.id = self.store.create({}, "v", awaits_upload=awaits).id
        self.tokens = ["never-issued"]
        self.before = self.row()
        self.published = 0
        self.entries = 1

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            self.folder.cleanup()

    def row(self) -> Job:
        job = self.store.get(self.id)
        assert job is not None
        return job

    token = st.integers(0, 5)

    def pick(self, index: int) -> str:
        return self.tokens[-1 - index % len(self.tokens)]

    @rule(seconds=st.sampled_from([1.0, 30.0, LEASE + 1]))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    @rule()
    def claim(self) -> None:
        before = self.row()
        free = before.state == JobState.QUEUED or (
            before.state == JobState.RUNNING
            and before.lease_until is not None
            and before.lease_until < self.now
        )
        claim = self.store.claim(self.id, lease_seconds=LEASE)
        allowed = free and before.attempt < MAX_ATTEMPTS
        assert (claim is not None) == allowed
        if claim is not None:
            self.tokens.append(claim.token)
            assert claim.attempt == before.attempt + 1

    @rule(index=token)
    def heartbeat(self, index: int) -> None:
        before = self.row()
        beat = self.store.heartbeat(self.id, self.pick(index), LEASE)
        assert (beat != Heartbeat.LOST) == (before.token == self.pick(index))

    @rule(index=token, fraction=st.floats(0, 1))
    def progress(self, index: int, fraction: float) -> None:
        before = self.row()
        written = self.store.report_progress(self.id, self.pick(index), "fit", fraction)
        assert written == (before.token == self.pick(index))
        if before.token == self.row().token:
            assert self.row().fraction >= before.fraction

    @rule(index=token, how=st.sampled_from(["succeed", "fail", "release", "crash", "cancel"]))
    def finish(self, index: int, how: str) -> None:
        before, token = self.row(), self.pick(index)
        match how:
            case "succeed":
                done = self.store.succeed(self.id, token, f"1-{token}")
                self.published += done
                allowed = not before.cancel_requested
            case "fail":
                done, allowed = self.store.fail(self.id, token, "c", "m", "a"), True
                if done and before.state == JobState.CANCELLING:
                    assert self.row().state == JobState.CANCELLED
            case "release":
                done, allowed = self.store.release(self.id, token), True
            case "crash":
                done, allowed = self.store.release(self.id, token, refund=False), True
            case _:
                done, allowed = self.store.finish_cancel(self.id, token), before.cancel_requested
        assert done == (allowed and before.token == token)

    @rule()
    def user_cancels(self) -> None:
        before = self.row().state
        said = self.store.request_cancel(self.id)
        match before:
            case JobState.AWAITING_UPLOAD | JobState.QUEUED | JobState.CANCELLED:
                assert (said, self.row().state) == (Cancel.CANCELLED, JobState.CANCELLED)
            case JobState.RUNNING | JobState.CANCELLING:
                assert (said, self.row().state) == (Cancel.REQUESTED, JobState.CANCELLING)
            case _:
                assert (said, self.row().state) == (Cancel.FINISHED, before)

    @rule(how=st.sampled_from(["arrives", "expires", "refused"]))
    def upload_ends(self, how: str) -> None:
        before = self.row().state
        match how:
            case "arrives":
                done = self.store.upload_arrived(self.id, 7)
            case "expires":
                done = self.store.expire_upload(self.id)
            case _:
                done = self.store.upload_refused(self.id, "video.unsupported_container", "m", "a")
        assert done == (before == JobState.AWAITING_UPLOAD)

    @rule()
    def reconcile(self) -> None:
        self.store.requeue_expired_leases()
        for job_id in self.store.due_for_publish():
            self.store.mark_published(job_id)

    @invariant()
    def moves_are_in_the_table(self) -> None:
        if not hasattr(self, "store"):
            return
        before, after = self.before, self.row()
        self.before = after
        if before.state != after.state:
            assert after.state in TRANSITIONS[before.state]
        assert 0 <= after.attempt <= MAX_ATTEMPTS
        assert (after.token is not None) == (after.state in HELD_STATES)
        assert (after.finished_at is not None) == (after.state in FINAL_STATES)
        assert (after.artifact is not None) == (after.state == JobState.SUCCEEDED)
        assert (after.error_code is not None) == (after.state == JobState.FAILED)
        assert self.published <= 1
        if after.state == JobState.QUEUED:
            assert after.attempt < MAX_ATTEMPTS

    @invariant()
    def the_journal_tells_it_all_in_order(self) -> None:
        if not hasattr(self, "store"):
            return
        row, new = self.row(), self.store.events(self.id, self.entries - 1)
        entries = self.store.events(self.id)
        assert [entry.seq for entry in entries] == [*range(1, row.event_seq + 1)]
        assert new == entries[self.entries - 1 :]
        self.entries = len(entries)
        assert entries[-1].data["state"] == row.state
        for one, two in pairwise(entries):
            assert (
                two.data["state"] == one.data["state"] or two.data["state"] in TRANSITIONS[one.data["state"]]
            )
            again = two.data["attempt"] > one.data["attempt"] or two.kind == "state"
            assert again or two.data["fraction"] >= one.data["fraction"]


TestJobLife = JobLife.TestCase
TestJobLife.settings = hypothesis_settings(max_examples=40, stateful_step_count=30, deadline=None)
