"""The wake-up message on a real broker."""

from __future__ import annotations

import base64
import json
import tempfile
from pathlib import Path

import redis

from service.embedded import EmbeddedBroker
from service.queue import TASK, create_queue
from service.settings import Settings


def test_the_message_is_a_hint_in_json_and_nothing_else() -> None:
    # A short path: the socket's may have no more than about 100 characters.
    with tempfile.TemporaryDirectory(prefix="mq") as folder, EmbeddedBroker(Path(folder)) as broker:
        queue = create_queue(Settings(data_dir=Path(folder), redis_url=broker.url))
        assert queue.publish("a-job-id")
        queue.close()
        with redis.Redis(unix_socket_path=broker.url.split("://")[1]) as client:
            (message,) = client.lrange("mass:cpu", 0, -1)
    sent = json.loads(message)
    assert sent["content-type"] == "application/json"
    assert sent["headers"]["task"] == TASK
    arguments, keywords, _ = json.loads(base64.b64decode(sent["body"]))
    assert (arguments, keywords) == (["a-job-id"], {})


def test_a_broker_that_is_not_there_is_reported(tmp_path: Path) -> None:
    queue = create_queue(Settings(data_dir=tmp_path))
    assert queue.publish("a-job-id") is False
    queue.close()
