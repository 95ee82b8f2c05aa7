"""A server that speaks S3 over HTTP: moto's, in a thread. A double of the wire, not of our client."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager

import boto3
from moto.server import ThreadedMotoServer

#: What the double takes; children inherit them.
CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_EC2_METADATA_DISABLED": "true",
}


class S3Server:
    """On a free port of the loopback."""

    def __init__(self) -> None:
        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        self._server.start()
        host, port = self._server.get_host_and_port()
        self.endpoint = f"http://{host}:{port}"
        self._names = itertools.count(1)

    def bucket(self, versions: bool = False) -> str:
        """The URL of a new bucket, with a prefix in it."""
        name = f"bucket{next(self._names)}"
        client = boto3.client("s3", endpoint_url=self.endpoint, region_name="us-east-1")
        client.create_bucket(Bucket=name)
        if versions:
            client.put_bucket_versioning(Bucket=name, VersioningConfiguration={"Status": "Enabled"})
        return f"s3://{name}/mass/files?endpoint={self.endpoint}"

    def contents(self, url: str) -> dict[str, bytes]:
        """Everything in the bucket of ``url``, older versions too."""
        client = boto3.client("s3", endpoint_url=self.endpoint, region_name="us-east-1")
        bucket = url.split("/")[2]
        found = {}
        for entry in client.list_object_versions(Bucket=bucket).get("Versions", ()):
            body = client.get_object(Bucket=bucket, Key=entry["Key"], VersionId=entry["VersionId"])["Body"]
            found[f"{entry['Key']}@{entry['VersionId']}"] = body.read()
        return found

    def close(self) -> None:
        self._server.stop()


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """Start one, with credentials in the environment, and leave the environment as it was."""
    before = {name: os.environ.get(name) for name in CREDENTIALS}
    os.environ.update(CREDENTIALS)
    server = S3Server()
    try:
        yield server
    finally:
        server.close()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
