#!/usr/bin/python3
"""Thousands of connections to a booth: those that say nothing, half a greeting, or nonsense, and those that subscribe and
never read. A well-behaved client beside them must be answered, and memory must stay bounded.

    connections.py [--count N] BIN_DIR

Opens N connections of each kind on the local sockets, and N strangers on the encrypted one, who must be let go again.
Prints what a connection costs and how long `system.status` takes meanwhile. Fails when a connection costs more than
64 KiB, the strangers are not let go, descriptors are left when all are gone, or the booth no longer answers. Exit status
77: a Python module is missing.
"""

import argparse
import contextlib
import os
import pathlib
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "faults"))
try:
    from tiny_booth import Booth
except ImportError as missing:
    print(f"SKIPPED: {missing}")
    sys.exit(77)

MOST_KIB_A_CONNECTION = 64
CONNECTED_WITHIN_S = 10
GONE_WITHIN_S = 60
ASKED = 100
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)  # ZMTP 3.0, a client's
READY_SUB = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
SUBSCRIBE_ALL = b"\x00\x01\x01"
KINDS = {"silent": b"", "half a greeting": GREETING[:11], "nonsense": bytes(range(256)) * 4,
         "a subscriber that never reads": GREETING + READY_SUB + SUBSCRIBE_ALL}


def measure(pid):
    """Resident KiB and descriptors of a process."""
    status = dict(line.split(":", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]), len(os.listdir(f"/proc/{pid}/fd"))


def connect(address, greeting):
    """One connection; None where it is refused."""
    family = socket.AF_INET if isinstance(address, tuple) else socket.AF_UNIX
    opened = socket.socket(family)
    opened.settimeout(CONNECTED_WITHIN_S)
    deadline = time.monotonic() + CONNECTED_WITHIN_S
    try:
        while True:
            try:
                opened.connect(address)
                break
            except BlockingIOError:  # as many as the system queues wait already
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.001)
        if greeting:
            opened.sendall(greeting)
        return opened
    except OSError:
        opened.close()
        return None


def ask(booth):
    """How long each of some answers takes, in seconds."""
    waits = []
    for _ in range(ASKED):
        asked = time.monotonic()
        booth.call("system.status")
        waits.append(time.monotonic() - asked)
    return waits


def told(waits):
    return (f"median {1e3 * statistics.median(waits):.1f} ms, "
            f"99 % within {1e3 * sorted(waits)[int(0.99 * (len(waits) - 1))]:.1f} ms")


def wait_descriptors(pid, most):
    deadline = time.monotonic() + GONE_WITHIN_S
    while measure(pid)[1] > most and time.monotonic() < deadline:
        time.sleep(0.1)
    return measure(pid)[1] <= most


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("bin_dir")
    given = parser.parse_args()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    count = min(given.count, most // (len(KINDS) + 3))
    with tempfile.TemporaryDirectory(prefix="booth-connections-") as folder:
        keys = pathlib.Path(folder) / "keys"
        subprocess.run([pathlib.Path(given.bin_dir) / "boothctl", "keys", "server", "--folder", keys], check=True,
                       stdout=subprocess.DEVNULL)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        booth = Booth(given.bin_dir, folder)
        booth.api = (f'remote_control = "tcp://127.0.0.1:{port}"\nserver_key = "{keys}/server.key"\n'
                     f'client_keys = "{keys}/clients"\n')
        assert booth.start(), booth.log()
        try:
            return try_connections(booth, ("127.0.0.1", port), count)
        finally:
            booth.kill()


def try_connections(booth, remote, count):
    pid, faults = booth.process.pid, []
    print(f"alone: {told(ask(booth))}")
    memory, descriptors = measure(pid)
    with contextlib.ExitStack() as stack:
        for kind, greeting in KINDS.items():
            before, _ = measure(pid)
            path = (booth.events if "subscriber" in kind else booth.control).removeprefix("ipc://")
            opened = [stack.enter_context(c) for c in (connect(path, greeting) for _ in range(count)) if c]
            waits = ask(booth)
            after, _ = measure(pid)
            if len(opened) < count:
                faults.append(f"{kind}: {count - len(opened)} were refused")
            cost = (after - before) / max(1, len(opened))
            print(f"{len(opened)} connections, {kind}: {cost:.1f} KiB each; {told(waits)}")
            if cost > MOST_KIB_A_CONNECTION:
                faults.append(f"{kind}: {cost:.1f} KiB a connection")
        all_of_them, before = measure(pid)
        for kind in ("silent", "nonsense"):
            for _ in range(count):
                if (c := connect(remote, KINDS[kind])) is not None:
                    stack.enter_context(c)
        print(f"{2 * count} strangers more on the encrypted socket: {told(ask(booth))}")
        if not wait_descriptors(pid, before):
            faults.append("strangers are not let go")
        print(f"memory {memory / 1024:.1f} MiB alone, {all_of_them / 1024:.1f} MiB with all local connections")
    if not wait_descriptors(pid, descriptors):
        faults.append(f"descriptors: {descriptors} before, {measure(pid)[1]} when all were gone")
    print(f"when all are gone: {told(ask(booth))}")
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
