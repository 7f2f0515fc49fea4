#!/usr/bin/env python3
"""How long a visitor waits: from the last frame of a capture to the published avatar, in a running booth.

    live_wait.py BIN RECORDING [--captures 3] [--face MODE]

BIN holds boothd and booth-reconstruct. A booth plays the recording at the pace of its cameras, once with jobs that begin
while their capture is still under way and once without (jobs.head_start). Needs pyzmq.
"""

import argparse
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import zmq

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "daemon/api/python"))
from avatar_booth import Booth, BoothUnreachable  # noqa: E402

READY_S = 60
ENDS = ("avatar.published", "capture.failed", "job.failed")


def wait_ready(booth: Booth) -> None:
    """Until every camera is online, and the empty booth has had time to be learned."""
    deadline = time.monotonic() + READY_S
    while time.monotonic() < deadline:
        try:
            status = booth.call("system.status")
            if status["state"] == "idle" and not status.get("not_ready"):
                return time.sleep(5)
        except BoothUnreachable:
            pass
        time.sleep(0.2)
    sys.exit("the booth did not become ready")


def capture(booth: Booth, events: zmq.Socket, face: str) -> float:
    """Seconds from the last shot's event to the avatar's."""
    booth.call("capture.start", face=face, countdown_s=1)
    last_shot = time.monotonic()
    while True:
        event = events.recv_multipart()[0].decode()
        if event == "capture.shot":
            last_shot = time.monotonic()
        if event in ENDS:
            if event != "avatar.published":
                sys.exit(event)
            return time.monotonic() - last_shot


def waits(binaries: pathlib.Path, recording: pathlib.Path, head_start: bool, face: str, captures: int) -> list[float]:
    """The wait of each of some captures, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        control, published = f"ipc://{folder}/control", f"ipc://{folder}/events"
        config = pathlib.Path(folder, "boothd.toml")
        config.write_text(
            f'[booth]\nstate_directory = "{folder}/state"\n'
            f'[api]\ncontrol = "{control}"\nevents = "{published}"\n'
            f"[jobs]\nhead_start = {str(head_start).lower()}\n"
            f'[replay]\nrecording = "{recording.resolve()}"\npace = "real"\n',
            encoding="utf-8",
        )
        daemon = subprocess.Popen(
            [binaries / "boothd", "--config", config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            events = zmq.Context.instance().socket(zmq.SUB)
            events.connect(published)
            events.setsockopt(zmq.SUBSCRIBE, b"")
            with Booth(control, published) as booth:
                wait_ready(booth)
                return [capture(booth, events, face) for _ in range(captures)]
        finally:
            daemon.terminate()
            daemon.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binaries", metavar="BIN", type=pathlib.Path)
    parser.add_argument("recording", metavar="RECORDING", type=pathlib.Path)
    parser.add_argument("--captures", type=int, default=3)
    parser.add_argument("--face", default="auto", choices=["auto", "active", "passive", "none"])
    arguments = parser.parse_args()
    medians = []
    for head_start in (True, False):
        seconds = waits(arguments.binaries, arguments.recording, head_start, arguments.face, arguments.captures)
        medians.append(statistics.median(seconds))
        began = "while the capture is under way" if head_start else "when the capture is over"
        print(f"jobs that begin {began}: " + ", ".join(f"{s:.2f} s" for s in seconds))
    print(f"ratio of the medians: {medians[0] / medians[1]:.2f}")


if __name__ == "__main__":
    main()
