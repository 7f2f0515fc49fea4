"""A client of the booth's interface: JSON-RPC 2.0 over ZeroMQ, and the booth's events.

    from avatar_booth import Booth

    with Booth() as booth:
        capture = booth.start_capture(label="Anna")
        avatar = booth.wait_for_avatar(capture)
        texture = booth.fetch(avatar, "texture.png")

Needs pyzmq. One client is for one thread.
"""

from __future__ import annotations

import hashlib
import json
import pathlib
import time
import uuid
from dataclasses import dataclass, field
from typing import Any, Iterator, Optional

import zmq

API = 1
CONTROL = "ipc:///run/booth/control"
EVENTS = "ipc:///run/booth/events"


class BoothError(Exception):
    """The booth's refusal: its `kind` is a stable word, its text a sentence for an operator."""

    def __init__(self, code: int, kind: str, message: str):
        super().__init__(message)
        self.code, self.kind = code, kind


class BoothUnreachable(Exception):
    """Nobody answered in time."""


@dataclass(frozen=True)
class Event:
    topic: str
    fields: dict[str, Any]
    bytes: Optional[bytes] = field(default=None, repr=False)  # of a preview: its JPEG


@dataclass(frozen=True)
class Status:
    """What front ends need of `system.status`; `all` has the rest."""

    state: str
    ready: bool
    not_ready: list[dict[str, str]]
    capture: Optional[str]
    boot: str
    sequence: int
    all: dict[str, Any] = field(repr=False)


class Booth:
    """@param key  a file that `boothctl keys add` made, for tcp:// endpoints"""

    def __init__(self, control: str = CONTROL, events: str = EVENTS, *, key: Optional[str] = None,
                 timeout_s: float = 5):
        self._control_endpoint, self._events_endpoint = control, events
        self._timeout_s = timeout_s
        self._keys = json.loads(pathlib.Path(key).read_text()) if key else None
        self._context = zmq.Context()
        self._calls = 0
        self._control = self._connect(zmq.DEALER, control)
        self._subscriber: Optional[zmq.Socket] = None

    def __enter__(self) -> Booth:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._context.destroy(linger=0)

    def _connect(self, kind: int, endpoint: str) -> zmq.Socket:
        socket = self._context.socket(kind)
        socket.linger = 0
        if self._keys:
            socket.curve_serverkey = self._keys["server_key"].encode()
            socket.curve_publickey = self._keys["public_key"].encode()
            socket.curve_secretkey = self._keys["secret_key"].encode()
        if kind == zmq.SUB:
            socket.subscribe(b"")
        socket.connect(endpoint)
        return socket

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        return self.call_with_bytes(method, **params)[0]

    def call_with_bytes(self, method: str, **params: Any) -> tuple[dict[str, Any], bytes]:
        """The result, and the bytes of the second frame where the method has one."""
        self._calls += 1
        self._control.send_json({"jsonrpc": "2.0", "id": self._calls, "method": method, "params": params})
        deadline = time.monotonic() + self._timeout_s
        while (left := deadline - time.monotonic()) > 0 and self._control.poll(left * 1000):
            frames = self._control.recv_multipart()
            reply = json.loads(frames[0])
            if "error" in reply and reply["id"] in (self._calls, None):
                error = reply["error"]
                raise BoothError(error["code"], error["data"]["kind"], error["message"])
            if reply["id"] == self._calls:  # else of an earlier call that was given up
                return reply["result"], frames[1] if len(frames) > 1 else b""
        raise BoothUnreachable(f"{self._control_endpoint} does not answer")

    def call_safely(self, method: str, **params: Any) -> dict[str, Any]:
        """Of a method that changes something: asked again where an answer is lost, and carried out once."""
        params.setdefault("key", uuid.uuid4().hex)
        try:
            return self.call(method, **params)
        except BoothUnreachable:
            return self.call(method, **params)

    def status(self) -> Status:
        told = self.call("system.status")
        return Status(told["state"], told["ready"], told["not_ready"], told["capture"], told["boot"],
                      told["sequence"], told)

    def history(self, *, hours: int = 24, limit: int = 100) -> list[dict[str, Any]]:
        """How the booth has been, oldest first, over restarts: at most `limit` samples of the last so many hours."""
        return self.call("system.history", hours=hours, limit=limit)["samples"]

    def subscribe(self) -> None:
        """Events from now on, or soon, come by events(). To be called before what one wants to hear of."""
        if self._subscriber is None:
            self._subscriber = self._connect(zmq.SUB, self._events_endpoint)

    def events(self, within_s: float) -> Iterator[Event]:
        """What happens, as it happens; ends when nothing was heard for so long (a heartbeat comes each second)."""
        self.subscribe()
        assert self._subscriber is not None
        while self._subscriber.poll(within_s * 1000):
            frames = self._subscriber.recv_multipart()
            yield Event(frames[0].decode(), json.loads(frames[1]), frames[2] if len(frames) > 2 else None)

    def start_capture(self, *, face: str = "auto", label: str = "", countdown_s: float = 0) -> str:
        """The capture's id."""
        self.subscribe()
        return self.call_safely("capture.start", face=face, label=label, countdown_s=countdown_s)["capture"]

    def wait_for_avatar(self, capture: str, within_s: float = 300) -> str:
        """The avatar's id. Raises BoothError when the capture or its job fails."""
        deadline = time.monotonic() + within_s
        asked = 0.0
        self.subscribe()
        while time.monotonic() < deadline:
            for event in self.events(1):
                if event.fields.get("capture") != capture:
                    break
                if event.topic == "capture.failed":
                    raise BoothError(0, event.fields["kind"], event.fields["message"])
                if event.topic in ("job.failed", "job.cancelled"):
                    raise BoothError(0, event.fields["error"]["kind"], event.fields["error"]["message"])
                if event.topic == "avatar.published":
                    return event.fields["avatar"]
            # What was lost on the way is in the list of jobs.
            if time.monotonic() - asked > 2:
                asked = time.monotonic()
                for job in self.call("job.list")["jobs"]:
                    if job["capture"] == capture and job["state"] == "done":
                        return job["avatar"]
                    if job["capture"] == capture and job["error"]:
                        raise BoothError(0, job["error"]["kind"], job["error"]["message"])
        raise BoothUnreachable(f"no avatar of {capture} within {within_s} s")

    def avatars(self) -> Iterator[dict[str, Any]]:
        """Newest first."""
        before: dict[str, str] = {}
        while page := self.call("avatar.list", limit=500, **before)["avatars"]:
            yield from page
            before = {"before": page[-1]["id"]}

    def fetch(self, avatar: str, file: str) -> bytes:
        """The whole file, checked by its SHA-256."""
        data = b""
        while True:
            told, piece = self.call_with_bytes("avatar.fetch", avatar=avatar, file=file, offset=len(data))
            data += piece
            if not piece or len(data) >= told["size"]:
                break
        if hashlib.sha256(data).hexdigest() != told["sha256"]:
            raise BoothError(0, "damaged", f"{file} was damaged on the way")
        return data

    def delete_avatar(self, avatar: str) -> None:
        """With its recording and every other trace of the person."""
        self.call_safely("avatar.delete", avatar=avatar)
