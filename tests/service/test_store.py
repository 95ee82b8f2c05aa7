"""The job table: one winner per claim, nothing written by who lost it, nothing lost."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.jobs import journal
from service.jobs.idempotency import (
    REMEMBERED,
    RESERVED,
    IdempotencyKeys,
    Made,
    Reservation,
    ReservationLostError,
    parse_key,
)
from service.jobs.leases import Claim, Heartbeat
from service.jobs.model import JobState, is_job_id, new_job_id
from service.jobs.store import Cancel, JobStore, create_store
from service.settings import Settings


class Clock:
    def __init__(self) -> None:
        self.now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[JobStore]:
    store = create_store(Settings(data_dir=tmp_path, max_attempts=2), clock)
    yield store
    store.close()


def state(store: JobStore, job_id: str) -> JobState:
    job = store.get(job_id)
    assert job is not None
    return job.state


def claimed(store: JobStore, job_id: str) -> Claim:
    claim = store.claim(job_id, lease_seconds=60)
    assert claim is not None
    return claim


def test_a_new_job_is_queued_with_what_it_was_given(store: JobStore) -> None:
    job = store.create({"side": "left"}, "uploads/x/source", video_bytes=7)
    found = store.get(job.id)
    assert found is not None
    assert is_job_id(found.id)
    assert (found.state, found.options, found.video, found.video_bytes) == (
        JobState.QUEUED,
        {"side": "left"},
        "uploads/x/source",
        7,
    )
    assert found.attempt == 0


def test_ids_sort_by_creation_and_other_texts_are_no_ids() -> None:
    ids = [new_job_id(1_000.0 + second) for second in range(50)]
    assert ids == sorted(ids)
    assert len(set(ids)) == 50
    assert all(map(is_job_id, ids))
    for text in ("", "..", ids[0].upper(), ids[0] + "\n", f"../{ids[0]}", ids[0].replace("-", "")):
        assert not is_job_id(text)


@pytest.mark.parametrize("expired", [False, True])
def test_of_many_claims_at_once_exactly_one_wins(tmp_path: Path, clock: Clock, expired: bool) -> None:
    settings = Settings(data_dir=tmp_path, max_attempts=3)
    stores = [create_store(settings, clock) for _ in range(4)]
    for _ in range(10):
        job = stores[0].create({}, "v")
        if expired:
            claimed(stores[0], job.id)
            clock.now += 61
        together = threading.Barrier(4)

        def race(
            store: JobStore, together: threading.Barrier = together, job_id: str = job.id
        ) -> Claim | None:
            together.wait()
            return store.claim(job_id)

        with ThreadPoolExecutor(4) as threads:
            claims = [claim for claim in threads.map(race, stores) if claim is not None]
        assert len(claims) == 1
        assert claims[0].attempt == (2 if expired else 1)
    for store in stores:
        store.close()


WRITES: list[Callable[[JobStore, str, str], bool]] = [
    lambda store, job, token: store.report_progress(job, token, "fit", 0.5),
    lambda store, job, token: store.succeed(job, token, "1-x"),
    lambda store, job, token: store.fail(job, token, "video.no_hand", "No hand.", "Show one."),
    lambda store, job, token: store.release(job, token),
    lambda store, job, token: store.release(job, token, refund=False),
    lambda store, job, token: store.finish_cancel(job, token),
]


@pytest.mark.parametrize("write", WRITES)
def test_who_lost_the_lease_changes_nothing(
    store: JobStore, clock: Clock, write: Callable[[JobStore, str, str], bool]
) -> None:
    job = store.create({}, "v")
    first = claimed(store, job.id)
    clock.now += 61
    second = claimed(store, job.id)
    assert second.attempt == 2
    before = store.get(job.id)
    assert write(store, job.id, first.token) is False
    assert store.heartbeat(job.id, first.token) == Heartbeat.LOST
    after = store.get(job.id)
    assert before is not None
    assert after is not None
    assert {c: getattr(before, c) for c in before.__table__.columns.keys()} == {  # noqa: SIM118
        c: getattr(after, c)
        for c in after.__table__.columns.keys()  # noqa: SIM118
    }
    assert store.heartbeat(job.id, second.token) == Heartbeat.OK


def test_a_heartbeat_keeps_the_lease(store: JobStore, clock: Clock) -> None:
    job = store.create({}, "v")
    claim = claimed(store, job.id)
    for _ in range(5):
        clock.now += 50
        assert store.heartbeat(job.id, claim.token, 60) == Heartbeat.OK
        assert store.claim(job.id) is None
        assert store.requeue_expired_leases() == []
    clock.now += 61
    assert store.requeue_expired_leases() == [job.id]
    assert state(store, job.id) == JobState.QUEUED


def test_a_job_whose_workers_keep_dying_fails_with_advice(store: JobStore, clock: Clock) -> None:
    job = store.create({}, "v")
    for expected in ([job.id], []):
        claimed(store, job.id)
        clock.now += 61
        assert store.requeue_expired_leases() == expected
    assert store.claim(job.id) is None
    found = store.get(job.id)
    assert found is not None
    assert found.state == JobState.FAILED
    assert found.error_code == "worker.lost"
    assert found.error_advice
    assert found.finished_at == clock.now


def test_an_expired_lease_can_be_taken_over_only_while_attempts_are_left(
    store: JobStore, clock: Clock
) -> None:
    job = store.create({}, "v")
    for attempt in (1, 2):
        assert claimed(store, job.id).attempt == attempt
        clock.now += 61
    assert store.claim(job.id) is None


def test_a_crashed_engine_costs_an_attempt_and_an_orderly_stop_does_not(store: JobStore) -> None:
    job = store.create({}, "v")
    for _ in range(5):
        claim = claimed(store, job.id)
        assert claim.attempt == 1
        assert store.release(job.id, claim.token)
    for expected in (JobState.QUEUED, JobState.FAILED):
        claim = claimed(store, job.id)
        assert store.release(job.id, claim.token, refund=False)
        assert state(store, job.id) == expected
    found = store.get(job.id)
    assert found is not None
    assert found.error_code == "worker.lost"


def test_progress_never_falls_within_an_attempt_and_starts_again_with_the_next(store: JobStore) -> None:
    job = store.create({}, "v")
    claim = claimed(store, job.id)
    for fraction in (0.2, 0.1, 0.7, 0.5, 3.0):
        before = store.get(job.id)
        assert before is not None
        assert store.report_progress(job.id, claim.token, f"s{fraction}", fraction, 5.0, "m")
        found = store.get(job.id)
        assert found is not None
        assert found.fraction == max(before.fraction, min(fraction, 1.0))
        assert (found.stage == f"s{fraction}") == (fraction > before.fraction)
    found = store.get(job.id)
    assert found is not None
    assert (found.fraction, found.stage, found.time_left, found.message) == (1.0, "s3.0", 5.0, "m")
    store.release(job.id, claim.token)
    claimed(store, job.id)
    found = store.get(job.id)
    assert found is not None
    assert (found.fraction, found.stage) == (0.0, None)


def test_success_names_the_artifact_and_clears_the_lease(store: JobStore) -> None:
    job = store.create({}, "v")
    claim = claimed(store, job.id)
    assert claim.artifact == f"1-{claim.token}"
    assert store.succeed(job.id, claim.token, claim.artifact)
    assert not store.succeed(job.id, claim.token, claim.artifact)
    found = store.get(job.id)
    assert found is not None
    assert (found.state, found.artifact, found.fraction) == (JobState.SUCCEEDED, claim.artifact, 1.0)
    assert (found.token, found.lease_until) == (None, None)


def test_cancel_queued_running_twice_and_after_the_end(store: JobStore) -> None:
    queued = store.create({}, "v")
    for _ in range(2):
        assert store.request_cancel(queued.id) == Cancel.CANCELLED
    assert store.claim(queued.id) is None

    running = store.create({}, "v")
    claim = claimed(store, running.id)
    assert store.request_cancel(running.id) == Cancel.REQUESTED
    assert store.request_cancel(running.id) == Cancel.REQUESTED
    assert store.heartbeat(running.id, claim.token) == Heartbeat.CANCEL
    assert not store.succeed(running.id, claim.token, claim.artifact)
    assert store.finish_cancel(running.id, claim.token)
    assert state(store, running.id) == JobState.CANCELLED
    done = store.create({}, "v")
    claim = claimed(store, done.id)
    assert store.succeed(done.id, claim.token, claim.artifact)
    assert store.request_cancel(done.id) == Cancel.FINISHED
    assert store.request_cancel(new_job_id()) == Cancel.UNKNOWN


def test_a_cancelled_job_is_never_queued_again(store: JobStore, clock: Clock) -> None:
    released = store.create({}, "v")
    claim = claimed(store, released.id)
    store.request_cancel(released.id)
    assert store.release(released.id, claim.token)
    assert state(store, released.id) == JobState.CANCELLED

    silent = store.create({}, "v")
    claimed(store, silent.id)
    store.request_cancel(silent.id)
    clock.now += 61
    assert store.requeue_expired_leases() == []
    assert state(store, silent.id) == JobState.CANCELLED


def test_a_deleted_job_is_hidden_at_once_and_purged_when_no_worker_holds_it(
    store: JobStore, clock: Clock
) -> None:
    job = store.create({}, "v")
    claim = claimed(store, job.id)
    assert store.delete(job.id)
    assert not store.delete(job.id)
    assert store.get(job.id) is None
    assert store.page() == ([], None)
    assert store.request_cancel(job.id) == Cancel.UNKNOWN
    assert store.due_for_purge() == []
    assert not store.purge(job.id)
    assert store.known({job.id, "x"}) == {job.id}
    assert store.heartbeat(job.id, claim.token) == Heartbeat.CANCEL
    clock.now += 61
    assert store.due_for_purge() == [job.id]
    assert store.purge(job.id)
    assert store.known({job.id}) == set()
    assert store.heartbeat(job.id, claim.token) == Heartbeat.LOST


def test_pages_follow_each_other_without_gap_or_repeat(store: JobStore, clock: Clock) -> None:
    ids = []
    for _ in range(7):
        clock.now += 1
        ids.append(store.create({}, "v").id)
    seen: list[str] = []
    cursor: str | None = None
    while True:
        jobs, cursor = store.page(3, cursor)
        seen += [job.id for job in jobs]
        # A job that arrives while somebody reads belongs on an earlier page.
        clock.now += 1
        store.create({}, "v")
        if cursor is None:
            break
    assert seen == ids[::-1]


def test_the_wake_up_is_sent_again_at_growing_distances(store: JobStore, clock: Clock) -> None:
    job = store.create({}, "v")
    assert store.due_for_publish() == []  # whoever created it is about to send it
    clock.now += 2
    assert store.due_for_publish() == [job.id]
    waits = []
    for _ in range(6):
        assert store.mark_published(job.id)
        sent = clock.now
        while store.due_for_publish() == []:
            clock.now += 10
        waits.append(clock.now - sent)
    assert waits == [60, 120, 240, 480, 600, 600]
    claim = claimed(store, job.id)
    assert store.due_for_publish() == []
    store.release(job.id, claim.token)
    assert store.due_for_publish() == [job.id]
    store.request_cancel(job.id)
    assert store.due_for_publish() == []
    assert not store.mark_published(new_job_id())


def test_jobs_survive_closing_and_opening_the_database(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    first = create_store(settings)
    job = first.create({"seed": 3}, "v")
    first.close()
    second = create_store(settings)
    found = second.get(job.id)
    assert found is not None
    assert found.options == {"seed": 3}
    second.close()


def test_an_awaited_upload_arrives_is_refused_or_expires(store: JobStore) -> None:
    arrives, refused, late = (store.create({}, "v", awaits_upload=True) for _ in range(3))
    assert store.claim(arrives.id) is None
    assert store.upload_arrived(arrives.id, 9)
    assert not store.upload_arrived(arrives.id, 9)
    assert claimed(store, arrives.id).attempt == 1
    assert store.upload_refused(refused.id, "video.empty", "m", "a")
    assert store.expire_upload(late.id)
    assert not store.expire_upload(arrives.id)
    assert [state(store, job.id) for job in (arrives, refused, late)] == ["running", "failed", "expired"]


def test_an_owner_sees_only_their_own(store: JobStore) -> None:
    mine, theirs = store.create({}, "v", owner="ann"), store.create({}, "v", owner="bob")
    assert store.get(mine.id, "bob") is None
    assert store.get(theirs.id, "bob") is not None
    assert [job.id for job in store.page(owner="ann")[0]] == [mine.id]
    store.request_cancel(mine.id)
    assert [job.id for job in store.page(states=[JobState.QUEUED])[0]] == [theirs.id]


def test_time_spent_is_booked_whichever_way_a_worker_lets_go(store: JobStore, clock: Clock) -> None:
    job = store.create({}, "v")
    claim = claimed(store, job.id)
    clock.now += 10
    store.release(job.id, claim.token)
    clock.now += 100
    claimed(store, job.id)
    clock.now += 61
    claim = claimed(store, job.id)  # taken over
    clock.now += 5
    store.request_cancel(job.id)
    store.finish_cancel(job.id, claim.token)
    found = store.get(job.id)
    assert found is not None
    assert found.busy_seconds == 76


def test_log_lines_are_bounded_and_only_the_holder_writes(store: JobStore) -> None:
    job = store.create({}, "v")
    assert not store.log(job.id, "stranger", ["x"])
    claim = claimed(store, job.id)
    assert store.log(job.id, claim.token, ["one", "t" * 5000])
    first, second = store.logs(job.id)
    assert (first.text, len(second.text), second.attempt) == ("one", journal.MAX_LINE, 1)
    assert [line.id for line in store.logs(job.id, after=first.id)] == [second.id]
    assert store.log(job.id, claim.token, ["m"] * journal.MAX_LINES)
    assert len(store.logs(job.id, limit=2 * journal.MAX_LINES)) == journal.MAX_LINES


def test_a_key_makes_one_job_whatever_happens_to_its_requests(tmp_path: Path, clock: Clock) -> None:
    store = create_store(Settings(data_dir=tmp_path), clock)
    keys = IdempotencyKeys(store.engine, clock)
    slow = keys.reserve("ann", "k")
    assert isinstance(slow, Reservation)
    assert keys.reserve("ann", "k") is None
    assert isinstance(keys.reserve("bob", "k"), Reservation)
    clock.now += RESERVED + 1
    retry = keys.reserve("ann", "k")
    assert isinstance(retry, Reservation)
    job = store.create({}, "v", owner="ann", idempotency_key=(retry, "f"))
    with pytest.raises(ReservationLostError):
        store.create({}, "v", owner="ann", idempotency_key=(slow, "f"))
    assert [found.id for found in store.page(owner="ann")[0]] == [job.id]
    keys.release(retry)
    keys.sweep()
    assert keys.reserve("ann", "k") == Made(job.id, "f")
    clock.now += REMEMBERED + 1
    assert isinstance(keys.reserve("ann", "k"), Reservation)
    store.close()


@pytest.mark.parametrize("header", ["", " ", "a b", "\u00fc", "x" * 129, '"a"b"'])
def test_what_is_no_idempotency_key(header: str) -> None:
    assert parse_key(header) is None
    assert parse_key('"abc"') == parse_key("abc") == "abc"
