#!/usr/bin/env python3
"""The schemas and the booth's reader of requests agree; the booth passes the conformance test, over its local sockets
and encrypted ones.

    schema_test.py BIN_DIR RECORDING SOURCE_DIR
"""

import contextlib
import pathlib
import random
import socket
import subprocess
import sys
import tempfile
import time

from conformance import Booth, BoothError, Schema

START_WITHIN_S = 60
# What may not be carried out while the test goes on.
LEFT_OUT = {"system.shutdown"}


def free_port():
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Values:
    """Values around what a schema takes, each with its own judgement by the validator."""

    def __init__(self, schema, seed):
        self.schema, self.random = schema, random.Random(seed)

    def of(self, schema):
        if "$ref" in schema:
            schema = self.schema.document["$defs"][schema["$ref"].rsplit("/", 1)[1]]
        if "enum" in schema:
            return self.random.choice([*schema["enum"], "none of them", 3])
        kind = schema.get("type")
        if kind == "string":
            longest = schema.get("maxLength", 20)
            length = self.random.choice([schema.get("minLength", 0), 0, 1, longest, longest + 1])
            return self.random.choice([self.random.choice("aü💡") * length, 7, None])
        if kind in ("integer", "number"):
            low, high = schema["minimum"], schema["maximum"]
            return self.random.choice([low, high, low - 1, high + 1, (low + high) // 2, "1", True, None, [1]])
        if kind == "boolean":
            return self.random.choice([True, False, "true", 0])
        raise AssertionError(f"no values for {schema}")

    def params(self, method):
        schema = self.schema.methods[method]["params"]
        made = {}
        for name, member in schema["properties"].items():
            if name == "key":
                # Each request's own, or one that is refused.
                if self.random.random() < 0.3:
                    made[name] = self.random.choice([f"k{self.random.getrandbits(60)}", "", "k" * 65, 5])
            elif self.random.random() < (0.9 if name in schema.get("required", []) else 0.5):
                made[name] = self.of(member)
        if self.random.random() < 0.1:
            made["unknown"] = 1
        return made


def check_agreement(booth, schema, rounds):
    """@return how many requests were made, and how many of them the schema refused"""
    values, made, refused = Values(schema, 5), 0, 0
    for method in booth.call("system.describe")["methods"]:
        params_schema = schema.methods[method]["params"]
        if kind_of(booth, method, {}) == "unsupported":
            continue
        for _ in range(rounds):
            params = values.params(method)
            valid = schema.is_valid(params_schema, params)
            if valid and method in LEFT_OUT:
                continue
            kind = kind_of(booth, method, params)
            # The end of a file is known by reading it, which a schema does not.
            assert valid == (kind != "invalid_params"), f"{method} {params}: valid {valid}, answered {kind}"
            made, refused = made + 1, refused + (not valid)
    return made, refused


def kind_of(booth, method, params):
    if method in LEFT_OUT and not params:
        return ""
    try:
        booth.call(method, **params)
        return ""
    except BoothError as refusal:
        return refusal.kind


def main(bin_dir, recording, source):
    bin_dir, source = pathlib.Path(bin_dir), pathlib.Path(source)
    schema = Schema(source / "daemon/api/schema/booth-api-1.json")
    with tempfile.TemporaryDirectory(prefix="booth-schema-") as folder:
        folder = pathlib.Path(folder)
        keys = folder / "keys"
        boothctl = [bin_dir / "boothctl", "keys"]
        subprocess.run([*boothctl, "server", "--folder", keys], check=True, stdout=subprocess.DEVNULL)
        for role in ("viewer", "operator"):
            subprocess.run([*boothctl, "add", role, "--folder", keys, "--role", role, "--out", folder / f"{role}.key"],
                           check=True, stdout=subprocess.DEVNULL)
        control, events = f"ipc://{folder}/control", f"ipc://{folder}/events"
        remote = [f"tcp://127.0.0.1:{free_port()}", f"tcp://127.0.0.1:{free_port()}"]
        config = folder / "boothd.toml"
        config.write_text(
            f'[booth]\nstate_directory = "{folder}/state"\n[disk]\nreserve_mib = 0\n[log]\nlevel = "error"\n'
            f'[api]\ncontrol = "{control}"\nevents = "{events}"\n'
            f'remote_control = "{remote[0]}"\nremote_events = "{remote[1]}"\n'
            f'server_key = "{keys}/server.key"\nclient_keys = "{keys}/clients"\n'
            f'[replay]\nrecording = "{pathlib.Path(recording).resolve()}"\npace = "fast"\n')
        boothd = subprocess.Popen([bin_dir / "boothd", "--config", config])
        try:
            with Booth(control, events, timeout_s=30) as booth:
                deadline = time.monotonic() + START_WITHIN_S
                while not booth.status().ready:
                    assert time.monotonic() < deadline, booth.status()
                    time.sleep(0.1)
            conformance = [sys.executable, source / "tests/conformance/conformance.py"]
            subprocess.run([*conformance, "--control", control, "--events", events, "--capture"], check=True)
            for role in ("viewer", "operator"):
                print(f"as {role}, encrypted:", flush=True)
                more = ["--key", folder / "operator.key"] if role == "operator" else ["--key", folder / "viewer.key"]
                done = subprocess.run([*conformance, "--control", remote[0], "--events", remote[1], *more],
                                      capture_output=True, text=True)
                # A viewer may not list avatars: that is the one check that it cannot pass.
                failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
                assert len(failed) == (role == "viewer"), done.stdout
            with Booth(control, events, timeout_s=30) as booth:
                made, refused = check_agreement(booth, schema, rounds=60)
                print(f"{made} generated requests, {refused} of them refused by schema and booth alike")
                assert made > 500 and 0.2 < refused / made < 0.95, (made, refused)
                booth.call("system.shutdown")
            assert boothd.wait(timeout=60) == 0
        finally:
            if boothd.poll() is None:
                boothd.kill()
    print("passed")


if __name__ == "__main__":
    main(*sys.argv[1:])
