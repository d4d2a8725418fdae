"""An S3 store on loopback, spoken to by the real protocol: it counts what it is asked, and fails on demand."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple
from urllib.request import Request as HttpRequest
from urllib.request import urlopen

import boto3
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server
from werkzeug.wrappers import Response

BUCKET = "fleet"
KEY_ID, SECRET = "AKIAVERYOPEN", "not/to+be=seen"  # what no message and no file may hold


class Request(NamedTuple):
    """What the store was asked: `PUT`, `/fleet/a.mcap`, `partNumber=1&uploadId=...`, and the range of bytes."""

    method: str
    path: str
    query: str
    range: str


Fault = Callable[[Request], str | None]


class Store:
    """The running server. `fault` says of each request what goes wrong: nothing, an HTTP status, or `cut`."""

    key_id, secret = KEY_ID, SECRET

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.fault: Fault = lambda _: None
        logging.getLogger("werkzeug").setLevel(logging.CRITICAL)  # a cut connection is its error, and our intention
        self._moto = DomainDispatcherApplication(create_backend_app)
        self._server = make_server("127.0.0.1", 0, self._answer, threaded=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _answer(self, environ: dict[str, Any], start: Any) -> Iterable[bytes]:
        request = Request(
            environ["REQUEST_METHOD"], environ["PATH_INFO"], environ.get("QUERY_STRING", ""), environ.get("HTTP_RANGE", "")
        )
        self.requests.append(request)
        wrong = self.fault(request)
        if wrong == "cut":
            return self._cut(environ, start)
        if wrong:
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            return Response(f"<Error><Code>{wrong}</Code><Message>told to</Message></Error>", int(wrong))(environ, start)
        return self._moto(environ, start)

    def _cut(self, environ: dict[str, Any], start: Any) -> Iterator[bytes]:
        """Half an answer to a reader, none to a writer, and the connection is gone."""
        if environ["REQUEST_METHOD"] == "GET":
            start("206 Partial Content", [("Content-Length", "100000"), ("Content-Type", "binary/octet-stream")])
            yield b"half of it"
        # a client that is still sending may not notice that nobody listens before its own patience ends
        environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
        raise ConnectionResetError("as told")

    def stop(self) -> None:
        """Ends the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def client(self) -> Any:
        """A client of its own, which sees what is really there."""
        return boto3.client(
            "s3", endpoint_url=self.url, region_name="us-east-1", aws_access_key_id=KEY_ID, aws_secret_access_key=SECRET
        )

    @property
    def environment(self) -> dict[str, str]:
        """By which a client finds the store and is let in."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": KEY_ID,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_MAX_ATTEMPTS": "2",
        }

    def empty(self) -> None:
        """Forgets everything: one bucket with nothing in it, and no request yet."""
        with urlopen(HttpRequest(f"{self.url}/moto-api/reset", method="POST")) as answer:
            answer.read()
        self.client.create_bucket(Bucket=BUCKET)
        self.requests.clear()

    def keys(self) -> list[str]:
        """Every object in the bucket."""
        return [entry["Key"] for entry in self.client.list_objects_v2(Bucket=BUCKET).get("Contents", [])]

    def uploads(self) -> list[str]:
        """Every upload in parts that was begun and neither ended nor aborted."""
        return [entry["Key"] for entry in self.client.list_multipart_uploads(Bucket=BUCKET).get("Uploads", [])]

    def put(self, key: str, data: bytes) -> str:
        """Stores an object, and returns its URL."""
        self.client.put_object(Bucket=BUCKET, Key=key, Body=data)
        return f"s3://{BUCKET}/{key}"

    def get(self, key: str) -> bytes:
        """The bytes of an object."""
        return bytes(self.client.get_object(Bucket=BUCKET, Key=key)["Body"].read())
