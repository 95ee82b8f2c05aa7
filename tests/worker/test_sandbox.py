"""What the engine may do, tried from inside."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.processes import launch
from service.settings import Settings
from tests.engine.video.broken import BROKEN
from tests.worker.harness import DEADLINE, REPOSITORY, Bench, alive, wait_for
from worker import confine, sandbox_probe
from worker.sandbox import Report, Sandbox, announce

CANARY = "c4n4ry-9f1b"


@pytest.fixture
def place() -> Iterator[Path]:
    """A data directory on a short path."""
    with tempfile.TemporaryDirectory(prefix="mass-box-", dir="/tmp") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def report() -> Report:
    """What a process that hides its memory, as the worker does, finds about the sandbox."""
    script = (
        "import json, sys; from pathlib import Path; from service.processes import hide_memory;"
        "from service.settings import Settings; from worker.sandbox import self_test;"
        "hide_memory(); report = self_test(Settings(data_dir=Path(sys.argv[1])));"
        "print(json.dumps([report.faults, report.user]))"
    )
    with tempfile.TemporaryDirectory(prefix="mass-box-", dir="/tmp") as folder:
        done = subprocess.run(
            [sys.executable, "-c", script, folder],
            cwd=REPOSITORY,
            env={**os.environ, "CANARY_SECRET": CANARY, "MASS_REDIS_URL": f"redis://:{CANARY}@host"},
            capture_output=True,
            text=True,
            timeout=2 * DEADLINE,
            check=True,
        )
    return Report(*json.loads(done.stdout))


@pytest.mark.parametrize(
    "measure",
    [
        *("process group", "network", "files", "environment", "capabilities", "other processes"),
        *("memory limit", "file size limit", "open files limit", "processor limit"),
    ],
)
def test_the_sandbox_holds(report: Report, measure: str) -> None:
    assert set(report.faults) == set(sandbox_probe.MEASURES)
    assert report.faults[measure] == ""


def test_what_cannot_be_had_is_said(report: Report, caplog: pytest.LogCaptureFixture) -> None:
    announce(report)
    for name in report.missing:
        assert f"sandbox: {name} could not be had" in caplog.text
    # Root that may become nobody, and any user who is not root, are unprivileged; else the reason is given.
    if "unprivileged user" in report.missing:
        assert report.user.startswith("root without capabilities: ")


def test_the_same_attempts_outside_the_sandbox_all_succeed(place: Path) -> None:
    """So the test of the sandbox is one that can fail."""
    (place / "secret").write_text("canary")
    (place / "video").write_text("video")
    target = sandbox_probe.Target(
        port=1,
        socket=str(place / "none"),
        secret=str(place / "secret"),
        outside=str(place / "outside"),
        inside=str(place / "inside"),
        video=str(place / "video"),
        parent=os.getpid(),
    )
    done = subprocess.run(
        [sys.executable, sandbox_probe.__file__, json.dumps(target)],
        env={"PATH": os.environ["PATH"], "CANARY_SECRET": CANARY},
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        check=True,
    )
    faults = json.loads(done.stdout)
    for name in ("process group", "files", "environment", "capabilities", "signals", "memory limit"):
        assert faults[name], name
    assert "CANARY_SECRET" in faults["environment"]
    assert faults["network"]  # a datagram socket can be connected to port 53 without anybody there
    assert not Report(faults, "").is_sound


def test_a_worker_that_must_shut_the_engine_in_and_cannot_does_not_start(place: Path) -> None:
    # As on a system whose kernel refuses Landlock and filters.
    weak = place / "confine.py"
    weak.write_text(
        f"import sys; sys.path.insert(0, {str(REPOSITORY)!r})\n"
        "from worker import confine\n"
        "confine._restrict_files = lambda *_: None\n"
        "confine._SYSCALLS = {}\n"
        "confine.main()\n"
    )
    starter = (
        "from worker import confine, sandbox; from worker.__main__ import main; import sys;"
        f"confine.__file__ = {str(weak)!r}; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", starter],
        cwd=REPOSITORY,
        env={**os.environ, "MASS_SANDBOX": "require", "MASS_DATA_DIR": str(place / "data")},
        capture_output=True,
        text=True,
        timeout=2 * DEADLINE,
    )
    assert done.returncode == 1, done.stderr
    assert "sandbox: files could not be had" in done.stderr
    assert "not starting" in done.stderr


def test_a_root_becomes_nobody_and_anybody_keeps_no_rights(place: Path) -> None:
    is_root = os.geteuid() == 0
    uid = 65534 if is_root else os.geteuid()
    place.chmod(0o755)
    run, video = place / "run", place / "video"
    run.mkdir()
    os.chown(run, uid, -1)
    video.write_bytes(b"video")
    spec = confine.Spec(
        parent=os.getpid(),
        user=[65534, 65534] if is_root else None,
        limits={"core": 0},
        read=["/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/proc/self", str(video)],
        device=["/dev/null"],
        write=[str(run)],
    )
    script = (
        f"id -u; grep -E 'CapEff|NoNewPrivs|Seccomp:' /proc/$$/status; cat {video}; echo;"
        f"echo x > {run}/new;"
        "cat /etc/shadow; exec sleep 600"
    )
    process = launch(
        [sys.executable, "-I", "-S", confine.__file__, json.dumps(spec), "/bin/sh", "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    lines = [process.stdout.readline().decode().split()[-1] for _ in range(5)]
    assert lines == [str(uid), "0000000000000000", "1", "2", "video"]
    wait_for("it wrote into its directory", lambda: (run / "new").exists())
    assert (run / "new").stat().st_uid == uid
    assert alive(process.pid)
    process.kill()
    _, errors = process.communicate(timeout=DEADLINE)
    assert b"shadow: Permission denied" in errors


def test_a_confined_engine_dies_with_its_worker(place: Path) -> None:
    run, video = place / "run", place / "video"
    run.mkdir()
    video.write_bytes(b"video")
    sandbox = Sandbox(Settings(data_dir=place / "data"))
    script = (
        "import json, sys, subprocess, time; from service.processes import launch;"
        "process = launch(json.loads(sys.argv[1]), stdout=subprocess.PIPE);"
        "print(process.stdout.readline().decode().strip(), process.pid, flush=True); time.sleep(600)"
    )
    # The command names its parent, which is the process started here.
    command = sandbox.command(["/bin/sh", "-c", "echo ready; sleep 600"], run, video)
    prepare = (
        "import os, json, sys; c = json.loads(sys.argv[1]); s = json.loads(c[4]); s['parent'] = os.getpid();"
        "c[4] = json.dumps(s); sys.argv[1] = json.dumps(c);"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", prepare + script, json.dumps(command)], cwd=REPOSITORY, stdout=subprocess.PIPE
    )
    assert parent.stdout is not None
    word, pid = parent.stdout.readline().decode().split()
    assert word == "ready"
    parent.kill()
    parent.communicate(timeout=DEADLINE)
    wait_for("the kernel ended it", lambda: not alive(int(pid)))


def test_the_environment_is_an_allow_list(place: Path) -> None:
    ours = {"PATH": "/bin", "MASS_REDIS_URL": f"redis://:{CANARY}@host", "MASS_MODEL_DIR": "/m", "TOKEN": "x"}
    seen = Sandbox(Settings(data_dir=place)).environment(place / "run", ours)
    assert CANARY not in json.dumps(seen)
    assert set(seen) == {
        *("PATH", "HOME", "TMPDIR", "USER", "MASS_MODEL_DIR", "PYTHONUNBUFFERED", "PYTHONFAULTHANDLER"),
    }


def test_memory_of_a_worker_is_closed_to_its_own_user() -> None:
    script = "from service.processes import hide_memory; hide_memory(); print('hid', flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"hid\n"
    assert Path(f"/proc/{process.pid}/environ").stat().st_uid == 0  # root's, whoever runs it
    process.communicate(b"\n", timeout=DEADLINE)


def test_an_engine_out_of_memory_costs_an_attempt_and_no_worker() -> None:
    bench = Bench(engine_memory_bytes=1 << 30)
    try:
        worker = bench.worker()
        job_id = bench.submit("memory")
        job = bench.until(job_id, "failed")
        assert (job.error_code, job.attempt) == ("engine.crashed", 3)
        assert len(bench.starts(job_id)) == 3
        bench.until(bench.submit(), "succeeded")
        assert worker.process.poll() is None
    finally:
        bench.close()


#: Of the engine's own corpus (tests/engine/video/broken.py runs all of it), one of each kind.
HOSTILE = (
    *("empty", "concat playlist", "playlist behind a magic number", "zip", "noise after a file type"),
    *("index cut off", "media in another file", "deeply nested boxes", "a hundred thousand tracks"),
    *("four thousand million claimed samples", "compressed index", "claims to last for days"),
    *("claims 16383x16383 in a frame", "one frame"),
)


def test_hostile_videos_end_in_their_code_at_the_first_attempt_and_the_worker_lives() -> None:
    """The real engine, in its sandbox, as jobs."""
    bench = Bench(engine_command=[sys.executable, "-m", "mass_engine"], lease_seconds=30.0)
    secret = f"{CANARY}-in-a-neighbour"
    (bench.settings.data_dir / "jobs" / "secret.txt").write_text(secret)
    try:
        workers = [bench.worker(CANARY_SECRET=CANARY).ready() for _ in range(2)]
        jobs: dict[str, tuple[str, str]] = {}
        for name in HOSTILE:
            make, code = BROKEN[name]
            source = bench.root / f"clip-{len(jobs)}" / "clip.mp4"
            source.parent.mkdir()
            make(source)
            jobs[bench.submit_file(source)] = (name, code)
        for job_id, (name, code) in jobs.items():
            job = bench.when(job_id, f"({name}) has failed", lambda job: job.state == "failed", 600.0)
            assert (job.error_code, job.attempt, name) == (code, 1, name), bench.logs()[-2000:]
            told = f"{job.error_message} {job.error_advice} {job.message}"
            assert str(bench.root) not in told
            assert secret not in told
            assert job.error_advice
        assert [w.process.poll() for w in workers] == [None, None]
        # What was asked for is nowhere: not in what users see, nor in what is logged.
        assert CANARY not in bench.logs()
        for path in bench.settings.data_dir.rglob("*"):
            if path.is_file() and path.name != "secret.txt":
                assert secret.encode() not in path.read_bytes(), path
    finally:
        bench.close()


def test_a_video_longer_than_allowed_is_refused_by_the_setting() -> None:
    from tests.engine.video.clips import make_clip, moving

    bench = Bench(
        engine_command=[sys.executable, "-m", "mass_engine"], max_video_seconds=0.3, lease_seconds=30.0
    )
    try:
        bench.worker()
        clip = make_clip(bench.root / "clip.mp4", moving(25))
        job = bench.until(bench.submit_file(clip), "failed", 5 * DEADLINE)
        assert (job.error_code, job.attempt) == ("video.too_long", 1)
    finally:
        bench.close()
