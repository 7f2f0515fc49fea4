#!/usr/bin/env python3
"""Whether a running booth keeps to its interface: what front ends may rely on.

    conformance.py [--control ENDPOINT] [--events ENDPOINT] [--key FILE] [--capture] [--schema FILE]

Asks what changes nothing. With --capture it also takes a capture, of nobody or of whoever stands there, follows it to
its avatar, and deletes that again. Each line is a check; the exit status is 0 when all passed.
"""

import argparse
import hashlib
import json
import pathlib
import sys
import time

for place in (pathlib.Path(__file__).resolve().parents[2] / "daemon/api/python",):
    if place.is_dir():
        sys.path.insert(0, str(place))
try:
    import jsonschema
    import zmq

    from avatar_booth import Booth, BoothError
except ImportError as missing:
    print(f"SKIPPED: {missing}; install python3-jsonschema and python3-zmq")
    sys.exit(77)

AVATAR_WITHIN_S = 300


def find_schema():
    for file in (pathlib.Path(__file__).resolve().parents[2] / "daemon/api/schema/booth-api-1.json",
                 pathlib.Path("/usr/share/avatar-booth/schema/booth-api-1.json")):
        if file.exists():
            return file
    sys.exit("booth-api-1.json is not found: name it with --schema")


class Schema:
    def __init__(self, file):
        self.document = json.loads(pathlib.Path(file).read_text())
        self.methods, self.topics = self.document["methods"], self.document["topics"]

    def check(self, schema, value):
        """Raises jsonschema.ValidationError."""
        whole = {**schema, "$defs": self.document["$defs"]}
        jsonschema.Draft202012Validator(whole).validate(value)

    def is_valid(self, schema, value):
        whole = {**schema, "$defs": self.document["$defs"]}
        return jsonschema.Draft202012Validator(whole).is_valid(value)

    def check_event(self, event):
        name = "preview.*" if event.topic.startswith("preview.") else event.topic
        if name not in self.topics:
            raise AssertionError(f"there is no topic {event.topic}")
        self.check(self.topics[name], event.fields)


class Conformance:
    def __init__(self, arguments):
        self.schema = Schema(arguments.schema or find_schema())
        self.arguments = arguments
        self.failures = 0

    def booth(self):
        return Booth(self.arguments.control, self.arguments.events, key=self.arguments.key, timeout_s=30)

    def run(self):
        checks = [self.describes_itself, self.answers_match, self.refuses_what_is_no_request,
                  self.refuses_unknown_parameters, self.repeats_an_answer, self.beats_each_second]
        if self.arguments.capture:
            checks.append(self.takes_a_capture)
        for check in checks:
            name = check.__name__.replace("_", " ")
            try:
                check()
                print(f"passed: {name}")
            except (AssertionError, BoothError, jsonschema.ValidationError) as fault:
                self.failures += 1
                print(f"FAILED: {name}: {fault}")
        return 1 if self.failures else 0

    def describes_itself(self):
        with self.booth() as booth:
            told = booth.call("system.describe")
        self.schema.check(self.schema.methods["system.describe"]["result"], told)
        unknown = set(told["methods"]) - set(self.schema.methods)
        assert not unknown, f"methods without a schema: {sorted(unknown)}"
        topics = {"preview.*" if name.startswith("preview.") else name for name in told["topics"]}
        assert topics <= set(self.schema.topics), f"topics without a schema: {topics - set(self.schema.topics)}"

    def answers_match(self):
        with self.booth() as booth:
            for method in ("system.describe", "system.status", "system.metrics", "system.history", "job.list",
                           "avatar.list"):
                self.schema.check(self.schema.methods[method]["result"], booth.call(method))

    def raw(self, text):
        """What comes back for a text, whatever it is."""
        with self.booth() as booth:
            booth._control.send(text)  # pylint: disable=protected-access
            assert booth._control.poll(30_000), f"no answer to {text[:60]!r}"
            return json.loads(booth._control.recv_multipart()[0])

    def refuses_what_is_no_request(self):
        for text, code in ((b"", -32700), (b"{", -32700), (b"\xff\xfe", -32700), (b"[]", -32600), (b"{}", -32600),
                           (b'{"jsonrpc":"2.0","id":1,"method":"no.such"}', -32601),
                           (b'{"jsonrpc":"2.0","id":1,"method":"system.status","params":[]}', -32602)):
            reply = self.raw(text)
            assert reply["error"]["code"] == code, f"{text!r}: {reply}"
            self.schema.check({"$ref": "#/$defs/error"}, reply["error"])

    def refuses_unknown_parameters(self):
        with self.booth() as booth:
            for method in booth.call("system.describe")["methods"]:
                try:
                    booth.call(method, no_such_parameter=1)
                    raise AssertionError(f"{method} took a parameter that is none")
                except BoothError as refusal:
                    assert refusal.kind in ("invalid_params", "forbidden"), f"{method}: {refusal.kind}"

    def repeats_an_answer(self):
        with self.booth() as booth:
            key = f"conformance-{time.time_ns()}"
            try:
                first = booth.call("avatar.delete", avatar="no-such-avatar", key=key)
            except BoothError as refusal:
                assert refusal.kind == "forbidden", refusal
                return
            assert booth.call("avatar.delete", avatar="no-such-avatar", key=key) == first
            try:
                booth.call("avatar.delete", avatar="another", key=key)
                raise AssertionError("a key was taken for another request")
            except BoothError as refusal:
                assert refusal.kind == "invalid_params", refusal

    def beats_each_second(self):
        beats, last = [], None
        with self.booth() as booth:
            for event in booth.events(5):
                self.schema.check_event(event)
                if not event.topic.startswith("preview."):
                    assert last is None or event.fields["sequence"] == last + 1, "an event is missing"
                    last = event.fields["sequence"]
                if event.topic == "heartbeat":
                    beats.append(time.monotonic())
                    if len(beats) == 3:
                        return
        raise AssertionError("the booth is silent")

    def takes_a_capture(self):
        with self.booth() as booth:
            booth.subscribe()
            next(booth.events(5), None)
            capture = booth.start_capture(face="none", label="conformance")
            fractions, deadline = [], time.monotonic() + AVATAR_WITHIN_S
            for event in booth.events(5):
                assert time.monotonic() < deadline, "it takes too long"
                self.schema.check_event(event)
                if event.fields.get("capture") != capture:
                    continue
                assert event.topic not in ("capture.failed", "job.failed"), event
                if event.topic == "job.progress":
                    fractions.append(event.fields["fraction"])
                if event.topic == "avatar.published":
                    break
            else:
                raise AssertionError("the booth fell silent")
            assert fractions == sorted(fractions), "progress fell"
            avatar = event.fields["avatar"]
            self.schema.check(self.schema.methods["avatar.list"]["result"], booth.call("avatar.list"))
            self.schema.check(self.schema.methods["job.list"]["result"], booth.call("job.list"))
            metadata = booth.call("avatar.get", avatar=avatar)
            for name, file in metadata["files"].items():
                assert hashlib.sha256(booth.fetch(avatar, name)).hexdigest() == file["sha256"], name
            told, piece = booth.call_with_bytes("avatar.fetch", avatar=avatar, file="metadata.json")
            self.schema.check(self.schema.methods["avatar.fetch"]["result"], told)
            assert json.loads(piece) == metadata
            booth.delete_avatar(avatar)
            assert avatar not in [found["id"] for found in booth.avatars()]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--control", default="ipc:///run/booth/control")
    parser.add_argument("--events", default="ipc:///run/booth/events")
    parser.add_argument("--key", help="for tcp:// endpoints: the client's key file")
    parser.add_argument("--capture", action="store_true", help="also take a capture")
    parser.add_argument("--schema", help="booth-api-1.json")
    return Conformance(parser.parse_args()).run()


if __name__ == "__main__":
    sys.exit(main())
