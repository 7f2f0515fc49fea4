#!/usr/bin/python3
"""One person after the other through a boothd with a front end attached: what it takes must not grow.

    soak.py [--sessions N] [--real [--recording DIR]] [--workers N] BIN_DIR

Prints memory, descriptors and threads after the warm-up and at the end, missed events, how long `system.status` takes
while jobs run, whether every frame of every trigger came, and how busy the processors were. With --real each session
is a recording (the small one) played at a camera's pace through the real reconstruction; else tiny pictures and a
program in place of it. With --workers the next people are captured while so many are being reconstructed. Fails when
descriptors or threads grew, an event was missed, a frame was missing or a shot taken again, or, from 200 sessions on,
memory grew by more than 2 %. Exit status 77: a Python module is missing.
"""

import argparse
import json
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


def processor_seconds(pid):
    """Of a process and of its children that have ended; then of the whole machine: busy, and all there was."""
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    machine = [int(n) for n in pathlib.Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    waiting = machine[3] + machine[4]  # idle, and for the disk
    ticks = os.sysconf("SC_CLK_TCK")
    return [n / ticks for n in (sum(int(n) for n in fields[11:15]), sum(machine) - waiting, sum(machine))]


def frames_of(recording):
    """What the triggers of a capture brought, by the shot's role: (camera, index) each; and its face mode."""
    found = {"body": set(), "gray_code": set()}
    text = json.loads((recording / "recording.json").read_text())
    for shot in text["shots"]:
        if shot["role"] in found:
            found[shot["role"]] |= {(frame["camera"], frame.get("index", 0)) for frame in shot["frames"]
                                    if (recording / frame["file"]).stat().st_size > 0}
    return found, text.get("face")


class Watch:
    """What a front end hears: no number of an event may be left out, no frame, and no shot be taken again."""

    def __init__(self, played):
        self.last = self.missed = self.heartbeats = self.frames = self.lost_frames = 0
        self.played, _ = frames_of(played)

    def look_at(self, recording):
        """Counts the frames of a capture."""
        found, face = frames_of(recording)
        for role, wanted in self.played.items():
            if role == "gray_code" and face == "none":
                continue
            self.frames += len(wanted)
            self.lost_frames += len(wanted - found[role])

    def hear(self, booth):
        published = set()
        for topic, event in booth.heard(STATUS_PAUSE_S):
            self.missed += max(0, event["sequence"] - self.last - 1) if self.last else 0
            self.last = event["sequence"]
            self.heartbeats += topic == "heartbeat"
            if topic in ("capture.failed", "job.failed"):
                raise AssertionError(f"{topic}: {event}")
            if topic == "capture.done":
                self.look_at(booth.state / "recordings" / event["capture"])
            if topic == "avatar.published":
                published.add(event["capture"])
        return published


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=500)
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--recording", type=pathlib.Path, default=MINI, help="that is played with --real")
    parser.add_argument("--workers", type=int, default=1, help="people reconstructed at the same time")
    parser.add_argument("bin_dir")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="booth-soak-") as folder:
        booth = Booth(given.bin_dir, folder, given.recording.resolve() if given.real else None, given.real,
                      "real" if given.real else "fast")
        booth.settings = f"[retention]\nmax_captures = {KEPT}\n[jobs]\nworkers = {given.workers}\n"
        assert booth.start(), booth.log()
        if not given.real:
            booth.behave("good", 0.05)
        try:
            return soak(booth, given.sessions, given.workers)
        finally:
            booth.kill()


def soak(booth, sessions, workers):
    pid, watch, waits, samples = booth.process.pid, Watch(booth.recording), [], []
    while not watch.heartbeats:
        watch.hear(booth)
    # One after the other; with more workers, all of them are kept at work, and one capture is ahead of them.
    at_once = 1 if workers == 1 else workers + 1
    begun, under_way = 0, {}  # the latter by capture: when it was begun
    began, used = time.monotonic(), processor_seconds(pid)
    while begun < sessions or under_way:
        asked = time.monotonic()
        status = booth.call("system.status")
        waits.append(time.monotonic() - asked)
        if begun < sessions and len(under_way) < at_once and status["ready"] and not status["capture"]:
            capture = booth.call("capture.start", face="none" if begun % 4 else "auto", label=f"guest {begun}",
                                 key=f"press {begun}")["capture"]
            under_way[capture] = asked
            begun += 1
        for capture in watch.hear(booth) & set(under_way):
            del under_way[capture]
            samples.append(measure(pid))
        for capture, since in under_way.items():
            assert asked < since + SESSION_WITHIN_S, f"no avatar: {booth.call('job.list', job=capture)}"
    seconds = time.monotonic() - began
    own, busy, there = (after - before for after, before in zip(processor_seconds(pid), used))
    retries = int(booth.call("system.metrics").get("shot_retries", 0))
    dropped = sum(camera["dropped"] for camera in booth.call("system.status")["cameras"])

    warm = min(max(KEPT, sessions // 10), sessions - 1)
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
          f"99 % within {1e3 * slowest:.1f} ms, all within {1e3 * max(waits):.1f} ms")
    print(f"{watch.frames - watch.lost_frames} of {watch.frames} frames came, {dropped} dropped, {retries} shots taken "
          f"again; processors busy for {100 * busy / there:.0f} % of the time, with the booth and its jobs for "
          f"{100 * own / there:.0f} %")
    kept = booth.call("avatar.list", limit=500)["avatars"]
    faults = []
    if watch.missed:
        faults.append("events were missed")
    if watch.lost_frames or dropped or retries or not watch.frames:
        faults.append("a trigger brought less than all frames")
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
