#!/usr/bin/python3
"""The booth under faults: killed, denied the disk, with failing cameras and a clock that jumps; each time it is started
again, and everything that was acknowledged must be there, whole or named as failed, and nothing half-made or left over.

    campaign.py [--full] [--seed N] [--only PART [--from OPERATION]] [--keep DIR] BIN_DIR SHIM

--from goes on with `operations` where another run was stopped. BIN_DIR holds boothd and booth-reconstruct, SHIM is the library that fault_shim.cpp becomes. Without --full a small part
is drawn, as continuous integration does. Exit status 77: a Python module is missing.
"""

import argparse
import collections
import contextlib
import errno
import mmap
import os
import pathlib
import random
import shutil
import signal
import struct
import sys
import tempfile
import time

try:
    from tiny_booth import (Booth, Refused, children_of, faults_of_avatar, faults_of_recording, names,
                            FACE_CAMERAS, BODY_CAMERAS)
except ImportError as missing:
    print(f"SKIPPED: {missing}")
    sys.exit(77)

MINI = pathlib.Path(__file__).resolve().parents[2] / "replay/recordings/mini"
SESSION_WITHIN_S = 60
SWEPT_WITHIN_S = 20
PROGRESS_EVERY_S = 60
MOST_KEPT = 12  # captures; the oldest are deleted, as a test of their own

INTERRUPTED = "the booth was stopped while capturing"

OFF, FAIL, TEAR, KILL_SELF, KILL_ALL = range(5)


class Control:
    """The memory that the shim shares, see fault_shim.cpp."""

    FIELDS = ["counting", "count", "mode", "first", "last", "error", "injected", "clock_step_ns", "daemon"]

    def __init__(self, file):
        file.write_bytes(bytes(512))
        with open(file, "r+b") as opened:
            self.memory = mmap.mmap(opened.fileno(), 512)

    def __getitem__(self, field):
        return struct.unpack_from("<q", self.memory, 8 * self.FIELDS.index(field))[0]

    def __setitem__(self, field, value):
        struct.pack_into("<q", self.memory, 8 * self.FIELDS.index(field), value)

    def what(self):
        return self.memory[72:].split(b"\0")[0].decode(errors="replace")

    def arm(self, mode, first=0, span=1, error=0):
        self["mode"] = OFF
        for field in ("count", "injected"):
            self[field] = 0
        self.memory[72:] = bytes(440)
        self["first"], self["last"], self["error"] = first, first + span - 1, error
        self["mode"], self["counting"] = mode, 1

    def disarm(self):
        self["counting"] = self["mode"] = OFF


class Campaign:
    def __init__(self, bin_dir, shim, folder, seed, full, first_operation):
        self.random = random.Random(seed)
        self.full, self.first_operation = full, first_operation
        self.folder = folder
        self.booth = Booth(bin_dir, folder)
        self.real = None
        self.control = Control(folder / "control-block")
        self.environment = {
            "LD_PRELOAD": str(shim), "FAULT_CONTROL": str(folder / "control-block"),
            "FAULT_ROOT": str(self.booth.state), "FAULT_LOG": str(folder / "operations"),
            # A sanitizer's library wants to be the first one, which need not be.
            "ASAN_OPTIONS": os.environ.get("ASAN_OPTIONS", "") + ":verify_asan_link_order=0"}
        self.begun, self.acknowledged, self.refused, self.deleted = set(), set(), {}, set()
        self.interrupted = 0
        self.found = []  # (what was done, what was wrong)
        self.injected = collections.Counter()
        self.checks = self.failed_jobs = 0

    # What a run does.

    def listen(self, wait_s=0.0):
        """Notes what the booth promises. Returns the captures that came to an end, one way or another"""
        ended = set()
        for topic, event in self.booth.heard(wait_s):
            if topic == "capture.done":
                self.acknowledged.add(event["capture"])
            if topic == "capture.failed":
                self.refused[event["capture"]] = event["message"]
            if topic in ("avatar.published", "job.failed", "capture.failed"):
                ended.add(event["capture"])
        return ended

    def session(self, face="auto"):
        """One capture, followed until its avatar is there, it has failed, or the booth is dead."""
        with contextlib.suppress(TimeoutError, Refused):
            capture = self.begin(face=face, label="Ann Other")
            deadline = time.monotonic() + SESSION_WITHIN_S
            while capture not in self.listen(0.05) and not self.is_over(capture):
                if self.booth.process.poll() is not None:
                    return
                if time.monotonic() > deadline:
                    raise AssertionError("neither an avatar nor a failure came")

    def begin(self, **how):
        """Starts a capture: from now on it must be there, or be named as failed."""
        capture = self.booth.call("capture.start", **how)["capture"]
        self.begun.add(capture)
        return capture

    def is_over(self, capture):
        """Asked, for an event may have come before the subscription had."""
        if self.booth.call("system.status")["capture"] == capture:
            return False
        try:
            job = self.booth.call("job.list", job=capture)["jobs"][0]
        except Refused:
            return True
        self.acknowledged.add(capture)
        return job["state"] not in ("queued", "running")

    def delete_some(self):
        """The oldest captures go; what was answered must be true for ever."""
        kept = sorted(self.acknowledged)
        for capture in kept[:-MOST_KEPT]:
            with contextlib.suppress(TimeoutError, Refused):
                self.booth.call("capture.delete", capture=capture)
                self.deleted.add(capture)
            self.acknowledged.discard(capture)

    def end(self):
        """Kills what is left and clears the way for a check."""
        if self.booth.subscriber:
            self.listen()
            self.booth.kill()
        self.control.disarm()
        self.control["clock_step_ns"] = 0

    # What must hold after it.

    def check(self, what):
        self.checks += 1
        wrong = []
        self.booth.settings = ""
        self.booth.behave("good", 0) if self.booth.reconstruct else None
        if not self.booth.start(self.environment):
            self.found.append((what, ["boothd does not start: " + self.booth.log()[-500:]]))
            self.booth.reap()
            return
        self.listen()
        self.booth.wait_idle()
        state = self.booth.state
        # A job that failed under a fault is named, and can be done again.
        failed = [j for j in self.booth.call("job.list")["jobs"] if j["state"] == "failed"]
        for job in [j for j in failed if j["error"]["message"] == INTERRUPTED]:
            # Named, and dismissed by the front end.
            failed.remove(job)
            self.interrupted += 1
            if job["id"] in self.acknowledged:
                wrong.append(f"LOST: capture {job['id']} was done, and is named as interrupted")
            self.refused[job["id"]] = INTERRUPTED
            self.booth.call("capture.delete", capture=job["id"])
        self.failed_jobs += len(failed)
        for job in failed:
            if not job["error"] or not job["error"]["message"]:
                wrong.append(f"job {job['id']} failed without a reason")
            self.booth.call("job.retry", job=job["id"])
        self.booth.wait_idle()

        recordings, avatars = ([n for n in names(state / folder) if not n.startswith(".")]
                               for folder in ("recordings", "avatars"))
        jobs = {j["id"]: j for j in self.booth.call("job.list")["jobs"]}
        listed = {a["id"] for a in self.booth.call("avatar.list", limit=500)["avatars"]}
        for capture in self.begun - self.acknowledged - self.deleted - set(self.refused) - set(recordings):
            wrong.append(f"LOST: capture {capture} was begun, and nobody says what became of it")
        self.begun.clear()
        for capture in self.acknowledged:
            job = jobs.get(capture)
            if capture not in recordings or job is None:
                wrong.append(f"LOST: capture {capture}, recording {capture in recordings}, job {job}")
            elif job["state"] != "done" or capture not in avatars:
                wrong.append(f"capture {capture} has no avatar: {job}")
        for capture in recordings:
            wrong += [f"recording {capture}: {f}" for f in faults_of_recording(state / "recordings" / capture)]
            if capture in self.refused:
                wrong.append(f"capture {capture} was told to have failed, and is there: {self.refused[capture]}")
            if capture not in jobs:
                wrong.append(f"recording {capture} has no job")
            self.acknowledged.add(capture)
        for avatar in avatars:
            wrong += [f"avatar {avatar}: {f}" for f in faults_of_avatar(state / "avatars" / avatar)]
        if set(avatars) != listed:
            wrong.append(f"avatars on the disk {avatars}, listed {sorted(listed)}")
        # A file may be in the making, and what a dying process still had is removed a while after the start.
        left, deadline = self.left_overs(), time.monotonic() + SWEPT_WITHIN_S
        while left and time.monotonic() < deadline:
            time.sleep(0.1)
            left &= self.left_overs()
        wrong += sorted(left)
        if wrong:
            self.found.append((what, wrong))
            print(f"  {what}: " + "; ".join(wrong), flush=True)
            self.acknowledged -= {c for c in self.acknowledged if c not in recordings}
        self.refused.clear()

    def left_overs(self):
        found = set()
        for path in self.booth.state.rglob("*"):
            if ".partial" in path.name or path.parent.name == "deleting":
                found.add(f"left over: {path}")
            if path.name.removesuffix(".json") in self.deleted:
                found.add(f"deleted, and still there: {path}")
        return found

    def run(self, what, during, environment=None):
        """The booth is running and checked; `during` does something to it; it is started again and checked."""
        try:
            during()
        except AssertionError as fault:
            self.found.append((what, [str(fault)]))
            print(f"  {what}: {fault}", flush=True)
        if self.control.what():
            what += f" ({self.control.what()})"
        self.end()
        self.check(what)
        if self.booth.process.poll() is None:
            self.delete_some()
            self.listen()

    # The parts.

    def kills(self):
        """SIGKILL of the booth, its pipeline's process, or both, at any instant of a session."""
        for number in range(240 if self.full else 16):
            victim = self.random.choice(["booth", "booth", "child"])
            seconds = self.random.uniform(0, 0.45)

            def during():
                self.booth.behave("good", 0.15)
                with contextlib.suppress(TimeoutError, Refused):
                    self.begin(face=self.random.choice(["auto", "none"]))
                    if self.acknowledged and self.random.random() < 0.2:
                        capture = self.random.choice(sorted(self.acknowledged))
                        self.booth.call("capture.delete", capture=capture)
                        self.acknowledged.discard(capture)
                        self.deleted.add(capture)
                until = time.monotonic() + seconds
                while time.monotonic() < until:
                    self.listen(0.005)
                if victim == "booth":
                    self.injected["kill of boothd"] += 1
                    return  # end() kills
                for child in children_of(self.booth.process.pid):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(child, signal.SIGKILL)
                    self.injected["kill of the pipeline"] += 1
                self.session()

            self.run(f"kill {number} of the {victim} after {seconds:.3f} s", during)

    def real_kills(self):
        """The same with the real reconstruction of the small recording."""
        tiny, state = self.booth, self.booth.state
        self.end()
        folder = self.folder / "real"
        folder.mkdir()
        self.booth = Booth(tiny.bin_dir, folder, MINI, real=True)
        kept = self.acknowledged, self.deleted
        self.acknowledged, self.deleted = set(), set()
        self.environment["FAULT_ROOT"] = str(self.booth.state)
        self.booth.start(self.environment)
        for number in range(12 if self.full else 1):
            seconds = self.random.uniform(0.2, 6)

            def during():
                self.begin(face="none")
                until = time.monotonic() + seconds
                while time.monotonic() < until:
                    self.listen(0.02)
                self.injected["kill of boothd in a real reconstruction"] += 1

            self.run(f"kill {number} of a real reconstruction after {seconds:.1f} s", during)
        self.booth.kill()
        self.booth, (self.acknowledged, self.deleted) = tiny, kept
        self.environment["FAULT_ROOT"] = str(state)
        self.booth.start(self.environment)

    def operations(self):
        """Each file operation of a session, and of a start, fails, is torn, or is the last one."""
        self.control.arm(OFF)
        self.session()
        self.booth.wait_idle()
        session_count = self.control["count"]
        self.end()
        self.control.arm(OFF)
        self.booth.start(self.environment)
        start_count = self.control["count"]
        self.control.disarm()
        print(f"  {session_count} file operations in a session, {start_count} in a start", flush=True)

        faults = [(FAIL, 1, errno.EIO), (FAIL, 1, errno.ENOSPC), (FAIL, 1000, errno.ENOSPC), (FAIL, 1, errno.EINTR),
                  (FAIL, 1000, errno.EIO), (TEAR, 1, 0), (TEAR, 1000, errno.ENOSPC), (KILL_SELF, 1, 0),
                  (KILL_ALL, 1, 0)]
        cases = [(True, at, fault) for at in range(1, session_count + 1) for fault in faults]
        cases += [(False, at, fault) for at in range(1, start_count + 1) for fault in faults
                  if fault[0] in (FAIL, KILL_SELF)]
        # Numbered through: those of a start follow those of a session.
        cases = [c for c in cases if c[1] + (0 if c[0] else session_count) >= self.first_operation]
        if not self.full:
            cases = self.random.sample(cases, min(30, len(cases)))
        told = time.monotonic()
        for in_session, at, (mode, span, error) in cases:
            name = {FAIL: errno.errorcode.get(error), TEAR: "torn write", KILL_SELF: "kill", KILL_ALL: "kill of all"}
            if time.monotonic() - told > PROGRESS_EVERY_S:
                told = time.monotonic()
                print(f"  at operation {at + (0 if in_session else session_count)} of {session_count + start_count}",
                      flush=True)
            what = f"{name[mode]}{' and on' if span > 1 else ''} at operation {at} of a " + \
                   ("session" if in_session else "start")
            if mode == TEAR and error:
                what = "torn write, then " + what

            def during():
                if in_session:
                    self.control["daemon"] = self.booth.process.pid
                    self.control.arm(mode, at, span, error)
                    self.session()
                else:
                    self.booth.kill()
                    self.control["daemon"] = 0
                    self.control.arm(mode, at, span, error)
                    if self.booth.start(self.environment):
                        self.session()
                if self.control["injected"]:
                    self.injected[name[mode]] += 1
                if self.booth.process.poll() is None and mode in (FAIL, TEAR):
                    # The disk is well again: so must be the booth, without a restart.
                    self.control.disarm()
                    before = len(self.acknowledged)
                    self.session()
                    if len(self.acknowledged) == before:
                        raise AssertionError("no capture any more after the fault: " +
                                             str(self.booth.call("system.status")["not_ready"]))

            self.run(what, during)

    def cameras(self):
        """Cameras that die, are late, or deliver damaged pictures."""
        for number in range(40 if self.full else 5):
            faults = []
            for _ in range(self.random.randint(1, 5)):
                faults.append(
                    f'[[replay.faults]]\nkind = "{self.random.choice(["missing", "late", "corrupt", "lost"])}"\n'
                    f'camera = "{self.random.choice(BODY_CAMERAS + FACE_CAMERAS + [""])}"\n'
                    f'role = "{self.random.choice(["body", "gray_code", "any"])}"\n'
                    f'index = {self.random.randint(0, 3)}\ncapture = {self.random.randint(0, 1)}\n'
                    f'delay_ms = {self.random.choice([20, 80, 400])}\n')

            def during():
                self.booth.kill()
                self.booth.settings = "".join(faults)
                self.booth.start(self.environment)
                self.injected["camera faults"] += len(faults)
                for _ in range(2):
                    self.session(self.random.choice(["auto", "active", "none"]))

            self.run(f"cameras {number}: " + " ".join(faults).replace("\n", " "), during)

    def clock(self):
        """The clock of the day jumps, forwards and backwards, in a session and between two."""
        steps = [3600, -3600, 86400 * 400, -86400 * 400, -1.5, 1.5, 86400 * 365 * 30, -86400 * 365 * 50]
        for seconds in steps if self.full else steps[:4]:

            def during():
                self.booth.behave("good", 0.05)
                for _ in range(2):
                    with contextlib.suppress(TimeoutError, Refused):
                        self.begin(face="none", key=f"{seconds} {_}")
                        time.sleep(self.random.uniform(0, 0.1))
                    self.control["clock_step_ns"] = int(seconds * 1e9)
                    self.injected["clock steps"] += 1
                    deadline = time.monotonic() + SESSION_WITHIN_S
                    while not self.listen(0.05) and time.monotonic() < deadline:
                        pass
                self.booth.wait_idle()
                self.listen()

            self.run(f"a clock step of {seconds} s", during)

    def flushes(self):
        """What is renamed into sight was flushed before; the folder that holds it, after."""
        log = pathlib.Path(self.environment["FAULT_LOG"])
        log.unlink(missing_ok=True)
        self.end()
        self.booth.start(self.environment)
        self.session()
        self.booth.wait_idle()
        self.booth.stop()  # which ends what is being written
        dirty, wrong = set(), []
        for line in log.read_text().splitlines():
            operation, path, *other = line.split("\t")
            path = os.path.normpath(path)
            if operation in ("create", "write", "truncate"):
                dirty.add(path)
            if operation in ("create", "mkdir", "link"):
                dirty.add(os.path.dirname(path))
            if operation == "fsync":
                dirty.discard(path)
            if operation == "rename":
                to = os.path.normpath(other[0])
                below = {p for p in dirty if p == path or p.startswith(path + "/")}
                if below and "/.partial-" not in to:
                    wrong.append(f"{to} appeared before {sorted(below)} were flushed")
                dirty -= below
                dirty.add(os.path.dirname(to))
        for name in ("recordings", "avatars", "jobs"):
            if str(self.booth.state / name) in dirty:
                wrong.append(f"the folder {name} was not flushed")
        if not any("recordings" in line for line in log.read_text().splitlines()):
            wrong.append("nothing was seen")
        self.checks += 1
        if wrong:
            self.found.append(("flushes", wrong))
            print("  " + "; ".join(wrong))
        self.booth.start(self.environment)

    def all(self, only):
        assert self.booth.start(self.environment), self.booth.log()
        for part in (self.flushes, self.kills, self.operations, self.cameras, self.clock, self.real_kills):
            if only and part.__name__ != only:
                continue
            began, before = time.monotonic(), self.checks
            print(f"{part.__name__}: {part.__doc__}", flush=True)
            part()
            print(f"  {self.checks - before} checks, {time.monotonic() - began:.0f} s", flush=True)
        self.booth.kill()
        for fault, count in sorted(self.injected.items()):
            print(f"{count:6} {fault}")
        lost = sum(text.startswith("LOST") for _, wrong in self.found for text in wrong)
        print(f"{sum(self.injected.values()):6} faults injected, {self.checks} restarts checked, "
              f"{self.interrupted} captures named as interrupted, "
              f"{self.failed_jobs} jobs named as failed and done again, {lost} captures lost, "
              f"{len(self.found)} findings")
        return 1 if self.found else 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only")
    parser.add_argument("--from", type=int, default=1, dest="first_operation")
    parser.add_argument("--keep", help="a new folder that stays, with the booth's log")
    parser.add_argument("bin_dir")
    parser.add_argument("shim")
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        if given.keep:
            folder = pathlib.Path(given.keep).resolve()
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        else:
            folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="booth-faults-")))
        campaign = Campaign(given.bin_dir, pathlib.Path(given.shim).resolve(), folder, given.seed, given.full,
                            given.first_operation)
        try:
            return campaign.all(given.only)
        finally:
            if campaign.booth.process and campaign.booth.process.poll() is None:
                campaign.booth.process.kill()


if __name__ == "__main__":
    sys.exit(main())
