#!/usr/bin/python3
"""One person after the other through a boothd with a front end attached: what it takes must not grow.

    soak.py [--sessions N] [--real] BIN_DIR

Prints memory, descriptors and threads after the warm-up and at the end, missed events, and how long `system.status`
takes while jobs run. With --real each session is the small recording through the real reconstruction; else tiny
pictures and a program in place of it. Fails when descriptors or threads grew, an event was missed, or, from 200
sessions on, memory grew by more than 2 %. Exit status 77: a Python module is missing.
"""

import argparse
import os
import pathlib
import statistics
import sys
import tempfile
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "faults"))
try:
    from tiny_booth import Booth
except ImportError as missing:
    print(f"SKIPPED: {missing}")
    sys.exit(77)

MINI = pathlib.Path(__file__).resolve().parents[2] / "replay/recordings/mini"
KEPT = 8  # captures, by [retention]: the warm-up makes that many
SESSION_WITHIN_S = 300
SWEEP_SLACK = 100  # sessions in the seconds between two looks of retention
FLAT = 0.02
LONG_ENOUGH = 200  # sessions: in fewer the allocator has not come to rest
STATUS_PAUSE_S = 0.05


def measure(pid):
    """Resident KiB, descriptors and threads of a process."""
    status = dict(line.split(":", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]), len(os.listdir(f"/proc/{pid}/fd")), int(status["Threads"])


class Watch:
    """What a front end hears: no number of an event may be left out."""

    def __init__(self):
        self.last = self.missed = self.heartbeats = 0

    def hear(self, booth):
        published = set()
        for topic, event in booth.heard(STATUS_PAUSE_S):
            self.missed += max(0, event["sequence"] - self.last - 1) if self.last else 0
            self.last = event["sequence"]
            self.heartbeats += topic == "heartbeat"
            if topic in ("capture.failed", "job.failed"):
                raise AssertionError(f"{topic}: {event}")
            if topic == "avatar.published":
                published.add(event["capture"])
        return published


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=500)
    parser.add_argument("--real", action="store_true")
    parser.add_argument("bin_dir")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="booth-soak-") as folder:
        booth = Booth(given.bin_dir, folder, MINI if given.real else None, real=given.real)
        booth.settings = f"[retention]\nmax_captures = {KEPT}\n"
        assert booth.start(), booth.log()
        if not given.real:
            booth.behave("good", 0.05)
        try:
            return soak(booth, given.sessions)
        finally:
            booth.kill()


def soak(booth, sessions):
    pid, watch, waits, samples = booth.process.pid, Watch(), [], []
    while not watch.heartbeats:
        watch.hear(booth)
    began = time.monotonic()
    for number in range(sessions):
        capture = booth.call("capture.start", face="none" if number % 4 else "auto", label=f"guest {number}",
                             key=f"press {number}")["capture"]
        deadline = time.monotonic() + SESSION_WITHIN_S
        while capture not in watch.hear(booth):
            asked = time.monotonic()
            booth.call("system.status")
            waits.append(time.monotonic() - asked)
            assert asked < deadline, f"no avatar: {booth.call('job.list', job=capture)}"
        samples.append(measure(pid))
    seconds = time.monotonic() - began

    warm = max(KEPT, sessions // 10)
    span = max(3, sessions // 10)
    first, last = samples[warm:warm + span], samples[-span:]
    memory, descriptors, threads = ([statistics.median(s[i] for s in part) for part in (first, last)] for i in range(3))
    growth = memory[1] / memory[0] - 1
    slowest = sorted(waits)[int(0.99 * (len(waits) - 1))]
    print(f"{sessions} sessions in {seconds:.0f} s, {watch.heartbeats} heartbeats, {watch.missed} events missed")
    print(f"memory {memory[0] / 1024:.1f} MiB after {warm} sessions, {memory[1] / 1024:.1f} MiB at the end "
          f"({100 * growth:+.1f} %); descriptors {descriptors[0]:.0f}, {descriptors[1]:.0f}; "
          f"threads {threads[0]:.0f}, {threads[1]:.0f}")
    print(f"system.status: {len(waits)} asked while jobs ran, median {1e3 * statistics.median(waits):.1f} ms, "
          f"99 % within {1e3 * slowest:.1f} ms")
    kept = booth.call("avatar.list", limit=500)["avatars"]
    faults = []
    if watch.missed:
        faults.append("events were missed")
    if descriptors[1] > descriptors[0] or threads[1] > threads[0]:
        faults.append("descriptors or threads grew")
    if sessions >= LONG_ENOUGH and growth > FLAT:
        faults.append("memory grew")
    if len(kept) > KEPT + SWEEP_SLACK:
        faults.append(f"{len(kept)} captures were kept")
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
