"""A motion through a real broker, a real worker and the real engine."""

from __future__ import annotations

import sys

import av

from service.jobs.model import JobKind, new_job_id
from tests.engine.avatars import small_avatar
from tests.worker.harness import Bench


def test_a_motion_is_rendered_by_a_worker() -> None:
    bench = Bench(engine_command=[sys.executable, "-m", "mass_engine"])
    try:
        bench.worker()
        small_avatar().save(bench.root)
        made = []
        for options in ({"width": 64, "height": 48, "fps": 5.0, "seconds": 1.0}, {"poses": ["nonsense"]}):
            job_id = new_job_id()
            avatar = bench.storage.share(bench.root / "avatar.safetensors", job_id)
            bench.store.create(options, avatar, job_id=job_id, kind=JobKind.RENDER, parent=new_job_id())
            assert bench.publish(job_id)
            made.append(job_id)
        good = bench.until(made[0], "succeeded")
        assert good.artifact is not None
        assets = bench.storage.assets(good.id, good.artifact)
        assert [asset.name for asset in assets] == ["motion.mp4"]
        with av.open(str(bench.storage.artifact_path(good.id, good.artifact) / "motion.mp4")) as container:
            assert len([*container.decode(video=0)]) == 5
        bad = bench.until(made[1], "failed")
        assert bad.error_code == "options.invalid"
    finally:
        bench.close()
