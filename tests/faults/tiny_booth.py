"""A boothd that plays a recording of tiny pictures, and a client of it: for tests that start it hundreds of times."""

import contextlib
import hashlib
import json
import os
import pathlib
import signal
import stat
import struct
import subprocess
import time
import zlib

import zmq

REPLY_WITHIN_S = 30
START_WITHIN_S = 60
IDLE_WITHIN_S = 120

BODY_CAMERAS = ["b0", "b1", "b2", "b3"]
FACE_CAMERAS = ["f0", "f1"]
WIDTH, HEIGHT = 16, 8
PATTERN = {"width": 4, "height": 2, "columns": True, "rows": True, "inverse": True}
PATTERNS = 8  # white, black, two bits of a column and one of a row, each with its inverse

# In place of booth-reconstruct: what the file "behaviour" beside it says.
RECONSTRUCT = """#!/usr/bin/python3
import hashlib, json, os, pathlib, signal, sys, time
if "--learn" in sys.argv:
    sys.exit(0)
recording, avatar = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
behaviour = (pathlib.Path(__file__).parent / "behaviour").read_text().split()
def say(stage, fraction):
    os.write(3, (json.dumps({"stage": stage, "fraction": fraction}) + "\\n").encode())
if behaviour[0] == "crash":
    os.kill(os.getpid(), signal.SIGSEGV)
say("load", 0.1)
time.sleep(float(behaviour[1]))
text = json.loads((recording / "recording.json").read_text())
for shot in text["shots"]:
    for frame in shot["frames"]:
        assert (recording / frame["file"]).read_bytes()[-8:-4] == b"IEND", frame
partial = avatar.parent / f".partial-{avatar.name}.{os.getpid()}.0"
def put(name, data):
    file = os.open(partial / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    while data:
        data = data[os.write(file, data):]
    os.fsync(file)
    os.close(file)
try:
    partial.mkdir()
    files = {"avatar.dae": os.urandom(4096), "texture.png": os.urandom(9000)}
    for name, data in files.items():
        put(name, data)
        time.sleep(float(behaviour[1]) / 4)
    put("metadata.json", json.dumps({
        "id": avatar.name, "created": text["created"], "recording": text["id"], "label": text.get("label", ""),
        "files": {n: {"size": len(d), "sha256": hashlib.sha256(d).hexdigest()} for n, d in files.items()},
        "triangles": 12, "warnings": []}).encode())
    folder = os.open(partial, os.O_RDONLY)
    os.fsync(folder)
    os.rename(partial, avatar)
    parent = os.open(avatar.parent, os.O_RDONLY)
    os.fsync(parent)
except OSError as fault:
    os.write(3, (json.dumps({"error": {"kind": "io", "message": str(fault)}}) + "\\n").encode())
    sys.exit(1)
say("export", 1.0)
"""


def png(value):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes([value]) * WIDTH) * HEIGHT
    header = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def write_tiny_recording(folder):
    view = {"width": WIDTH, "height": HEIGHT, "K": [[20, 0, 8], [0, 20, 4], [0, 0, 1]], "distortion": [0] * 5,
            "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 0]}
    cameras = [{"id": c, "role": "body", "mount_rotation_deg": 0, **view} for c in BODY_CAMERAS]
    cameras += [{"id": c, "role": "face", "mount_rotation_deg": 0, **view} for c in FACE_CAMERAS]
    rig = {"format": "booth-rig", "version": 1, "name": "tiny", "volume": {"min": [-1, 0, -1], "max": [1, 2, 1]},
           "cameras": cameras, "projector": {"id": "beamer", **view}}
    shots = []
    for name, role, count, members in [("background", "background", 1, BODY_CAMERAS + FACE_CAMERAS),
                                       ("body", "body", 1, BODY_CAMERAS + FACE_CAMERAS),
                                       ("face", "gray_code", PATTERNS, FACE_CAMERAS)]:
        frames = []
        for index in range(count):
            for number, camera in enumerate(members):
                file = f"frames/{name}/{camera}-{index:03}.png"
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(png(10 * index + number))
                frames.append({"camera": camera, "index": index, "file": file, "frame_id": index,
                               "timestamp_ns": 5_000_000_000 + index * 40_000_000 + number * 70_000,
                               "exposure_us": 4000, "gain_db": 0})
        shots.append({"name": name, "role": role, "frames": frames} |
                     ({"pattern": PATTERN} if role == "gray_code" else {}))
    (folder / "rig.json").write_text(json.dumps(rig))
    (folder / "recording.json").write_text(json.dumps(
        {"format": "booth-recording", "version": 1, "id": "tiny", "created": "2026-11-22T10:15:00Z",
         "rig": "rig.json", "shots": shots}))


def children_of(pid):
    found = []
    with contextlib.suppress(OSError):
        for task in os.listdir(f"/proc/{pid}/task"):
            found += [int(p) for p in pathlib.Path(f"/proc/{pid}/task/{task}/children").read_text().split()]
    return found


class Refused(Exception):
    """The booth answered with an error."""

    def __init__(self, error):
        super().__init__(f"{error['data']['kind']}: {error['message']}")
        self.kind = error["data"]["kind"]


class Booth:
    """A boothd on a folder, which it keeps from start to start."""

    def __init__(self, bin_dir, folder, recording=None, real=False, pace="fast"):
        self.bin_dir, self.folder = pathlib.Path(bin_dir), pathlib.Path(folder)
        self.state = self.folder / "state"
        self.control, self.events = f"ipc://{folder}/control", f"ipc://{folder}/events"
        self.recording, self.pace = recording, pace
        if recording is None:
            self.recording = self.folder / "tiny"
            write_tiny_recording(self.recording)
        self.reconstruct = None if real else self.folder / "reconstruct"
        if not real:
            self.reconstruct.write_text(RECONSTRUCT)
            self.reconstruct.chmod(stat.S_IRWXU)
            self.behave("good", 0)
        self.context = zmq.Context.instance()
        self.process = self.subscriber = self.requester = None
        self.requests = 0
        self.settings = self.api = ""  # TOML, the latter of the section [api]

    def behave(self, how, seconds):
        (self.folder / "behaviour").write_text(f"{how} {seconds}")

    def log(self):
        return (self.folder / "log").read_text(errors="replace")

    def launch(self, environment=None):
        """Starts the process, waiting for nothing."""
        config = self.folder / "boothd.toml"
        config.write_text(
            f'[booth]\nstate_directory = "{self.state}"\n[api]\ncontrol = "{self.control}"\nevents = "{self.events}"\n{self.api}'
            f'[capture]\nframe_timeout_ms = 1000\n[disk]\nreserve_mib = 0\n'
            f'[replay]\nrecording = "{self.recording}"\npace = "{self.pace}"\n{self.settings}')
        command = [self.bin_dir / "boothd", "--config", config]
        if self.reconstruct:
            command += ["--reconstruct", self.reconstruct]
        with open(self.folder / "log", "a") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | (environment or {}))
        self.subscriber = self.context.socket(zmq.SUB)
        self.subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        self.subscriber.setsockopt(zmq.RCVHWM, 0)
        self.subscriber.connect(self.events)

    def start(self, environment=None):
        """Until it is ready. False: the process ended before."""
        self.launch(environment)
        deadline = time.monotonic() + START_WITHIN_S
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                return False
            with contextlib.suppress(TimeoutError):
                if self.call("system.status", within_s=1)["ready"]:
                    return True
            time.sleep(0.01)
        raise AssertionError(f"not ready: {self.call('system.status')['not_ready']}")

    def kill(self):
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGKILL)
        self.reap()

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        return self.reap()

    def reap(self):
        code = self.process.wait(timeout=60)
        for socket in (self.subscriber, self.requester):
            if socket:
                socket.close(linger=0)
        self.subscriber = self.requester = None
        return code

    def request(self, method, within_s=REPLY_WITHIN_S, **params):
        """The reply and the frames behind it."""
        self.requests += 1
        if self.requester is None:
            self.requester = self.context.socket(zmq.REQ)
            self.requester.setsockopt(zmq.LINGER, 0)
            self.requester.connect(self.control)
        self.requester.send_json({"jsonrpc": "2.0", "id": self.requests, "method": method, "params": params})
        deadline = time.monotonic() + within_s
        while not self.requester.poll(50):
            if time.monotonic() > deadline or self.process.poll() is not None:
                self.requester.close()
                self.requester = None
                raise TimeoutError(method)
        frames = self.requester.recv_multipart()
        return json.loads(frames[0]), frames[1:]

    def call(self, method, within_s=REPLY_WITHIN_S, **params):
        reply, _ = self.request(method, within_s, **params)
        if "error" in reply:
            raise Refused(reply["error"])
        return reply["result"]

    def heard(self, wait_s=0.0):
        """Events that have come, as (topic, object)."""
        seen = []
        while self.subscriber.poll(wait_s * 1000 if not seen else 0):
            frames = self.subscriber.recv_multipart()
            seen.append((frames[0].decode(), json.loads(frames[1])))
        return seen

    def wait_idle(self):
        """Until no job is queued or running and no capture is under way."""
        deadline = time.monotonic() + IDLE_WITHIN_S
        while time.monotonic() < deadline:
            status = self.call("system.status")
            if not status["capture"] and not [j for j in status["queue"] if j["state"] in ("queued", "running")]:
                return
            time.sleep(0.01)
        raise AssertionError(f"the queue stands: {self.call('job.list')}")


def names(folder):
    return sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []


def faults_of_recording(folder):
    """What is wrong with a recording: nothing, where it is whole."""
    try:
        recording = json.loads((folder / "recording.json").read_text())
        json.loads((folder / "rig.json").read_text())
        faults = [] if {"background", "body"} <= {s["role"] for s in recording["shots"]} else ["shots are missing"]
        for shot in recording["shots"]:
            for frame in shot["frames"]:
                data = (folder / frame["file"]).read_bytes()
                if not (data[:2] == b"\xff\xd8" and data[-2:] == b"\xff\xd9" or data[-8:-4] == b"IEND"):
                    faults.append(f"{frame['file']} is torn")
        return faults
    except (OSError, ValueError, KeyError) as fault:
        return [repr(fault)]


def faults_of_avatar(folder):
    try:
        metadata = json.loads((folder / "metadata.json").read_text())
        faults = [] if metadata["files"] else ["no files"]
        for name, file in metadata["files"].items():
            data = (folder / name).read_bytes()
            if len(data) != file["size"] or hashlib.sha256(data).hexdigest() != file["sha256"]:
                faults.append(f"{name} is not what metadata.json says")
        return faults
    except (OSError, ValueError, KeyError) as fault:
        return [repr(fault)]
