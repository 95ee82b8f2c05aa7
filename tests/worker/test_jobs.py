"""Jobs through a real broker and a real worker process, one behaviour of the engine after another."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.jobs.store import Cancel
from tests.worker.fake_engine import FILES
from tests.worker.harness import DEADLINE, REPOSITORY, Bench, alive, wait_for


@pytest.fixture(scope="module")
def running() -> Iterator[Bench]:
    """One broker and one worker for all jobs of this file."""
    bench = Bench()
    try:
        bench.worker().ready()
        yield bench
    finally:
        bench.close()


def test_a_job_runs_to_success_and_its_files_are_published(running: Bench) -> None:
    job_id = running.submit(gated=True)
    running.engine(job_id)
    seen = running.when(job_id, "has progress", lambda job: job.stage is not None)
    assert (seen.stage, seen.fraction, seen.time_left, seen.message) == ("track", 0.25, 3.0, "frame 1 of 4")
    running.open_gate(job_id)
    job = running.until(job_id, "succeeded")
    assert (job.attempt, job.fraction, job.error_code) == (1, 1.0, None)
    assert job.artifact is not None
    published = {asset.name: asset.bytes for asset in running.storage.assets(job_id, job.artifact)}
    assert published == {name: len(content) for name, content in FILES.items()}
    assert len(running.starts(job_id)) == 1
    assert [line.text for line in running.store.logs(job_id)] == ["stage track"]
    said = [(entry.kind, entry.data["state"]) for entry in running.store.events(job_id)]
    assert said[:2] == [("state", "queued"), ("state", "running")]
    assert said[-1] == ("state", "succeeded")
    assert ("progress", "running") in said


def test_the_engine_gets_the_options_and_none_of_the_services_secrets(running: Bench) -> None:
    options = {"preset": "draft", "seed": 7, "fov": None, "max_frames": 30}
    job_id = running.job("environment", options=options)
    running.publish(job_id)
    job = running.until(job_id, "succeeded")
    assert job.artifact is not None
    seen = json.loads((running.storage.artifact_path(job_id, job.artifact) / "tracks.json").read_text())
    flags = [word for word in seen["argv"] if word.startswith("--") and word != "--out"]
    assert sorted(flags) == [
        *("--json", "--max-frames=30", "--max-seconds=600", "--preset=draft", "--seed=7")
    ]
    assert "CANARY_SECRET" in running.environment()
    assert [name for name in seen["env"] if name.startswith(("MASS_", "CANARY"))] == ["MASS_MODEL_DIR"]


def test_a_video_the_engine_cannot_use_fails_with_its_code(running: Bench) -> None:
    job_id = running.submit("reject")
    job = running.until(job_id, "failed")
    told = (job.error_code, job.error_message, job.error_advice)
    assert told == ("video.no_hand", "No hand was found.", "Film a hand.")
    assert len(running.starts(job_id)) == 1
    wait_for("its output is gone", lambda: not [*(running.settings.data_dir / "jobs" / job_id).iterdir()])
    wait_for("its video is gone", lambda: not (running.settings.data_dir / "uploads" / job_id).exists())


def test_arguments_the_engine_refuses_are_not_tried_again(running: Bench) -> None:
    job_id = running.submit("arguments")
    job = running.until(job_id, "failed")
    assert (job.error_code, job.error_advice) == ("options.invalid", "Use another.")
    assert len(running.starts(job_id)) == 1


def test_a_gpu_that_is_not_there_is_named_and_not_looked_for_again(running: Bench) -> None:
    job_id = running.submit("no_device", options={"device": "cuda"})
    job = running.until(job_id, "failed")
    assert (job.error_code, job.error_message) == ("device.unavailable", "There is no GPU.")
    assert len(running.starts(job_id)) == 1


def test_an_unknown_option_in_the_row_never_reaches_the_engine(running: Bench) -> None:
    job_id = running.job(options={"out": "/etc"})
    running.publish(job_id)
    assert running.until(job_id, "failed").error_code == "options.invalid"
    assert running.starts(job_id) == []


@pytest.mark.parametrize("mode", ["crash", "internal", "empty"])
def test_an_engine_that_breaks_is_started_three_times_exactly(running: Bench, mode: str) -> None:
    job_id = running.submit(mode)
    job = running.until(job_id, "failed")
    assert job.error_code == "engine.crashed"
    assert job.error_advice
    assert job.attempt == 3
    assert len(running.starts(job_id)) == 3
    # Another message about it starts nothing. Messages are taken in order, so the next job proves it.
    running.queue.publish(job_id)
    after = running.submit()
    running.until(after, "succeeded")
    assert len(running.starts(job_id)) == 3


def test_output_that_is_no_event_does_no_harm(running: Bench) -> None:
    job_id = running.submit("noise", gated=True)
    job = running.when(job_id, "has the last report", lambda job: job.stage == "fit")
    assert (job.fraction, job.time_left, len(job.message)) == (1.0, 0.0, 500)
    running.open_gate(job_id)
    running.until(job_id, "succeeded")


def test_a_process_left_behind_by_the_engine_is_ended_with_it(running: Bench) -> None:
    job_id = running.submit("child")
    running.until(job_id, "succeeded")
    words = (running.notebook / f"{job_id}.log").read_text().split()
    child = next(int(word.split(":")[1]) for word in words if word.startswith("child:"))
    wait_for("the child is gone", lambda: not alive(child))


@pytest.mark.parametrize("mode", ["succeed", "stubborn"])
def test_cancel_ends_a_running_engine(running: Bench, mode: str) -> None:
    job_id = running.submit(mode, gated=True)
    engine = running.engine(job_id)
    if mode == "stubborn":
        wait_for("the engine ignores SIGTERM", lambda: running.notes(job_id, "deaf"))
    assert running.store.request_cancel(job_id) is Cancel.REQUESTED
    wait_for("the engine is gone", lambda: not alive(engine), deadline=5.0)
    job = running.until(job_id, "cancelled")
    assert job.artifact is None
    assert running.notes(job_id, "end") == []
    assert running.store.request_cancel(job_id) is Cancel.CANCELLED


def test_deleting_a_running_job_ends_its_engine_and_leaves_no_file(running: Bench) -> None:
    job_id = running.submit(gated=True)
    engine = running.engine(job_id)
    assert running.store.delete(job_id)
    wait_for("the engine is gone", lambda: not alive(engine), deadline=5.0)
    wait_for("its row is purged", lambda: not running.store.known({job_id}))
    assert [*running.settings.data_dir.rglob(f"*{job_id}*")] == []


def test_twenty_messages_about_one_job_are_one_run(running: Bench) -> None:
    job_id = running.job()
    for _ in range(20):
        assert running.queue.publish(job_id)
    running.until(job_id, "succeeded")
    after = running.submit()
    running.until(after, "succeeded")
    assert len(running.starts(job_id)) == 1


def test_the_health_command_tells_a_live_worker_from_none(running: Bench) -> None:
    def health(data_dir: Path) -> subprocess.CompletedProcess[str]:
        environment = {**running.environment(), "MASS_DATA_DIR": str(data_dir)}
        command = [sys.executable, "-m", "worker.health"]
        return subprocess.run(
            command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=DEADLINE
        )

    alive = health(running.settings.data_dir)
    assert alive.returncode == 0
    assert str(running.workers[0].process.pid) in alive.stdout
    assert health(running.root / "elsewhere").returncode == 1


def test_a_message_about_no_job_is_dropped(running: Bench) -> None:
    running.queue.publish("no-such-job")
    running.until(running.submit(), "succeeded")


def test_a_full_gpu_is_tried_again_at_a_smaller_setting_and_the_owner_is_told(running: Bench) -> None:
    job_id = running.submit("device_memory", options={"preset": "full"}, suffices=["draft/None"])
    job = running.until(job_id, "succeeded")
    settings = [word for word in running.words(job_id) if word.startswith("setting:")]
    assert settings == ["setting:full/None", "setting:auto/None", "setting:draft/None"]
    # Three runs, each a process of its own, in one attempt; later ones may go on from the checkpoint.
    assert (job.attempt, len({*running.starts(job_id)})) == (1, 3)
    assert running.words(job_id).count("resume") == 2
    assert job.options == {"preset": "full"}
    assert [warning["code"] for warning in job.warnings] == [
        "video.dark",
        "device.smaller_setting",
        "device.smaller_setting",
    ]
    assert "draft" in job.warnings[-1]["message"]
    said = [line.text for line in running.store.logs(job_id)]
    assert said.count("error device.out_of_memory: Full.") == 2
    assert [line for line in said if "device.smaller_setting" in line and "preset auto" in line]


def test_a_gpu_that_is_always_full_fails_the_job_after_two_smaller_settings(running: Bench) -> None:
    job_id = running.submit("device_memory", options={"preset": "draft"}, suffices=[])
    job = running.until(job_id, "failed")
    settings = [word for word in running.words(job_id) if word.startswith("setting:")]
    assert settings == ["setting:draft/None", "setting:draft/80", "setting:draft/40"]
    assert (job.attempt, job.error_code) == (1, "device.out_of_memory")
    assert job.error_message is not None
    assert "80 frames" in job.error_message
    assert "40 frames" in job.error_message
    assert "cpu" in (job.error_advice or "")
