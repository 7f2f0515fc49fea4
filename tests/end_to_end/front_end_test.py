#!/usr/bin/python3
"""The booth as a front end sees it: a client in another language that has only ZeroMQ and JSON drives the real
programs from a recording to a published avatar, kills the booth on the way, and has the avatar deleted.

    front_end_test.py BIN_DIR RECORDING CHECK_AVATAR

BIN_DIR holds boothd, boothctl and booth-reconstruct. Exit status 77: a Python module is missing.
"""

import contextlib
import hashlib
import json
import pathlib
import signal
import subprocess
import sys
import tempfile
import time

try:
    import zmq
except ImportError:
    print("SKIPPED: python3-zmq is not installed")
    sys.exit(77)

REPLY_WITHIN_S = 10
START_WITHIN_S = 30
AVATAR_WITHIN_S = 300


class Booth:
    """A running boothd with a client's two sockets."""

    def __init__(self, bin_dir, state, recording):
        self.bin_dir, self.state = pathlib.Path(bin_dir), pathlib.Path(state)
        self.control, self.events = f"ipc://{state}/control", f"ipc://{state}/events"
        self.config = self.state / "boothd.toml"
        self.config.write_text(
            f'[booth]\nname = "end to end"\nstate_directory = "{state}/state"\n'
            f'[api]\ncontrol = "{self.control}"\nevents = "{self.events}"\n'
            f'[disk]\nreserve_mib = 0\n'
            f'[replay]\nrecording = "{recording}"\npace = "fast"\n'
            f'[export]\nanimation = true\nturntable = true\nformats = ["stl", "obj", "ply"]\n'
        )
        self.context = zmq.Context.instance()
        self.process = self.subscriber = None
        self.requests = 0

    def start(self):
        self.process = subprocess.Popen([self.bin_dir / "boothd", "--config", self.config])
        self.subscriber = self.context.socket(zmq.SUB)
        self.subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        self.subscriber.connect(self.events)
        deadline = time.monotonic() + START_WITHIN_S
        while True:
            assert self.process.poll() is None, f"boothd ended with {self.process.returncode}"
            with contextlib.suppress(TimeoutError):
                if self.call("system.status", within_s=1)["ready"]:
                    return
            assert time.monotonic() < deadline, f"not ready: {self.call('system.status')['not_ready']}"
            time.sleep(0.1)

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.subscriber.close(linger=0)

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(timeout=60)
        self.subscriber.close(linger=0)
        return code

    def request(self, method, within_s=REPLY_WITHIN_S, **params):
        """The reply object and the binary frames behind it."""
        self.requests += 1
        socket = self.context.socket(zmq.REQ)
        try:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(self.control)
            socket.send_json({"jsonrpc": "2.0", "id": self.requests, "method": method, "params": params})
            if not socket.poll(within_s * 1000):
                raise TimeoutError(method)
            frames = socket.recv_multipart()
        finally:
            socket.close()
        reply = json.loads(frames[0])
        assert reply["jsonrpc"] == "2.0" and reply["id"] == self.requests, reply
        return reply, frames[1:]

    def call(self, method, within_s=REPLY_WITHIN_S, **params):
        reply, _ = self.request(method, within_s, **params)
        assert "error" not in reply, f"{method}: {reply}"
        return reply["result"]

    def events_until(self, topic, within_s):
        """Every event up to the first of that topic, as (topic, object)."""
        seen, deadline = [], time.monotonic() + within_s
        while True:
            left = deadline - time.monotonic()
            assert left > 0 and self.subscriber.poll(left * 1000), f"no {topic} within {within_s} s: {seen[-5:]}"
            frames = self.subscriber.recv_multipart()
            seen.append((frames[0].decode(), json.loads(frames[1])))
            failed = seen[-1][0] in ("capture.failed", "job.failed")
            assert not failed or seen[-1][0] == topic, seen[-1]
            if seen[-1][0] == topic:
                return seen

    def fetch(self, avatar, file):
        """The whole file, in pieces smaller than it, its checksum verified."""
        data = b""
        while True:
            reply, frames = self.request("avatar.fetch", avatar=avatar, file=file, offset=len(data), length=100_000)
            assert "error" not in reply, reply
            data += frames[0]
            if not frames[0]:
                break
        assert len(data) == reply["result"]["size"]
        assert hashlib.sha256(data).hexdigest() == reply["result"]["sha256"]
        return data


def check_events(events):
    """Nothing is missed, progress never falls, and the stages come in their order."""
    sequences = [event["sequence"] for topic, event in events if not topic.startswith("preview.")]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences))), sequences
    assert len({event["boot"] for _, event in events}) == 1
    fractions = [event["fraction"] for topic, event in events if topic == "job.progress"]
    assert fractions and fractions == sorted(fractions), fractions


def main(bin_dir, recording, check_avatar):
    with tempfile.TemporaryDirectory(prefix="booth-e2e-") as state:
        booth = Booth(bin_dir, state, pathlib.Path(recording).resolve())
        try:
            booth.start()
            told = booth.call("system.describe")
            assert told["api"] == 1 and "capture.start" in told["methods"], told

            first = booth.call("capture.start", face="none", label="first", key="a-first")
            assert booth.call("capture.start", face="none", label="first", key="a-first") == first
            events = booth.events_until("avatar.published", AVATAR_WITHIN_S)
            check_events(events)
            published = events[-1][1]
            assert published["capture"] == first["capture"] and published["label"] == "first", published

            target = pathlib.Path(state) / "fetched"
            target.mkdir()
            for name in published["files"]:
                (target / name).write_bytes(booth.fetch(published["avatar"], name))
            subprocess.run([sys.executable, check_avatar, target], check=True)

            # Killed in the middle of a job: the capture stays, the job resumes, the avatar appears.
            second = booth.call("capture.start", face="none", label="second")
            booth.events_until("capture.done", AVATAR_WITHIN_S)
            booth.events_until("job.progress", AVATAR_WITHIN_S)
            booth.kill()
            booth.start()
            deadline = time.monotonic() + AVATAR_WITHIN_S
            while len(avatars := booth.call("avatar.list")["avatars"]) < 2:
                assert time.monotonic() < deadline, booth.call("job.list")
                time.sleep(0.2)
            assert [a["label"] for a in avatars] == ["second", "first"], avatars
            assert avatars[0]["capture"] == second["capture"]

            # The operator's command line sees the same.
            listed = subprocess.run(
                [booth.bin_dir / "boothctl", "--control", booth.control, "--events", booth.events, "--json",
                 "avatars", "list"], check=True, capture_output=True, text=True).stdout
            assert published["avatar"] in listed, listed

            for avatar in avatars:
                booth.call("avatar.delete", avatar=avatar["id"])
                booth.events_until("avatar.deleted", REPLY_WITHIN_S)
            assert booth.call("avatar.list")["avatars"] == []
            left = [p for name in ("recordings", "jobs", "avatars") for p in (booth.state / "state" / name).rglob("*")]
            assert not left, f"traces are left: {left}"
            assert booth.stop() == 0
        finally:
            if booth.process and booth.process.poll() is None:
                booth.process.kill()
    print("passed")


if __name__ == "__main__":
    main(*sys.argv[1:])
