#!/usr/bin/env python3
"""Where the time and the memory of whole jobs go.

    job.py BOOTH_RECONSTRUCT RECORDING [--runs 5] [--face MODE] [--threads N] [--trace FILE] [--markdown]

Runs the program several times, each in a process of its own, after a run that is not counted, in which it learns the
empty booth for all (but with --cold), and prints the run of median wall time: by stage the
processor time of all threads, the span from its first step's beginning to its last one's end, how busy the threads
were within it, and the resident memory at most. The trace of that run is kept with --trace; ui.perfetto.dev opens it.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time


def run_once(command: list[str], trace: pathlib.Path) -> dict:
    """One job. Returns its wall and processor seconds, its peak memory in MiB, and its trace."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.monotonic()
        with open(os.path.join(folder, "words"), "w+", encoding="utf-8") as words:
            child = subprocess.Popen(
                [*command, os.path.join(folder, "avatar"), "--trace", str(trace)], stdout=subprocess.DEVNULL, stderr=words
            )
            _, status, usage = os.wait4(child.pid, 0)
            wall = time.monotonic() - started
            words.seek(0)
            if status != 0:
                sys.exit(words.read())
    return {
        "wall": wall,
        "processor": usage.ru_utime + usage.ru_stime,
        "memory": usage.ru_maxrss / 1024,
        "trace": json.loads(trace.read_text()),
    }


def run_at_once(command: list[str], jobs: int) -> None:
    """So many jobs side by side, as boothd runs them with jobs.workers; prints how busy the processors were."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.monotonic()
        children = [
            subprocess.Popen([*command, os.path.join(folder, str(i))], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            for i in range(jobs)
        ]
        ends = [os.wait4(child.pid, 0) for child in children]
        wall = time.monotonic() - started
    if any(status != 0 for _, status, _ in ends):
        sys.exit(f"{command[0]} failed")
    processor = sum(usage.ru_utime + usage.ru_stime for _, _, usage in ends)
    share = processor / (wall * len(os.sched_getaffinity(0)))
    print(f"{jobs} jobs at once: {wall:.2f} s, {processor:.2f} s of processor time, processors busy for {share:.0%} of it")


def own_processor_time(events: list[dict]) -> list[tuple[dict, float]]:
    """Each event with its thread's processor time in seconds, that of the events inside it taken off."""
    own = []
    by_thread: dict[int, list[dict]] = {}
    for event in events:
        by_thread.setdefault(event["tid"], []).append(event)
    for of_thread in by_thread.values():
        around: list[list] = []
        for event in sorted(of_thread, key=lambda e: (e["ts"], -e["dur"])):
            while around and around[-1][0]["ts"] + around[-1][0]["dur"] < event["ts"] + event["dur"]:
                own.append(tuple(around.pop()))
            if around:
                around[-1][1] -= event["tdur"] / 1e6
            around.append([event, event["tdur"] / 1e6])
        own += [tuple(entry) for entry in around]
    return own


def stages(trace: dict, steps: bool) -> dict[str, dict]:
    """By stage (the part of a step's name before the colon), or by step, in the order of their beginning."""
    events = [event for event in trace["traceEvents"] if event["ph"] == "X"]
    memory = [event for event in trace["traceEvents"] if event["ph"] == "C"]
    found: dict[str, dict] = {}
    for event, own in sorted(own_processor_time(events), key=lambda entry: entry[0]["ts"]):
        name = event["name"] if steps else event["name"].split(":")[0]
        stage = found.setdefault(name, {"begin": event["ts"], "end": 0.0, "processor": 0.0})
        stage["end"] = max(stage["end"], event["ts"] + event["dur"])
        stage["processor"] += own
    for stage in found.values():
        within = [m["args"]["MiB"] for m in memory if stage["begin"] <= m["ts"] <= stage["end"]]
        stage["memory"] = max(within, default=0.0)
        stage["wall"] = (stage["end"] - stage["begin"]) / 1e6
    return found


def print_table(run: dict, steps: bool, markdown: bool) -> None:
    rows = [("stage", "processor s", "span s", "resident MiB")]
    for name, stage in stages(run["trace"], steps).items():
        rows.append((name, f"{stage['processor']:.2f}", f"{stage['wall']:.2f}", f"{stage['memory']:.0f}"))
    busy = run["processor"] / run["wall"]
    rows.append(("the whole process", f"{run['processor']:.2f}", f"{run['wall']:.2f}", f"{run['memory']:.0f}"))
    if markdown:
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        lines.insert(1, "| --- | --- | --- | --- |")
    else:
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
    print("\n".join(lines))
    print(f"\nThreads at work on average: {busy:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="booth-reconstruct")
    parser.add_argument("recording")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--face", default="auto")
    parser.add_argument("--config", help="the booth's configuration file")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--trace", type=pathlib.Path, help="keep the trace of the median run here")
    parser.add_argument("--steps", action="store_true", help="by step instead of by stage")
    parser.add_argument("--cold", action="store_true", help="learn the empty booth in every run")
    parser.add_argument("--at-once", type=int, default=0, help="run so many jobs side by side besides")
    parser.add_argument("--markdown", action="store_true")
    arguments = parser.parse_args()

    command = [arguments.program, "--face", arguments.face, "--threads", str(arguments.threads)]
    if arguments.config:
        command += ["--config", arguments.config]
    command.append(arguments.recording)
    with tempfile.TemporaryDirectory() as folder:
        if not arguments.cold:
            command += ["--cache", os.path.join(folder, "cache")]
            run_once(command, pathlib.Path(folder, "first.json"))
        runs = [run_once(command, pathlib.Path(folder, f"{i}.json")) for i in range(arguments.runs)]
        if arguments.at_once:
            run_at_once(command, arguments.at_once)
        runs.sort(key=lambda run: run["wall"])
        median = runs[len(runs) // 2]
        if arguments.trace:
            arguments.trace.write_text(json.dumps(median["trace"]))
    print_table(median, arguments.steps, arguments.markdown)
    processor = sorted(run["processor"] for run in runs)
    print(
        f"Of {len(runs)} runs: wall {runs[0]['wall']:.2f} to {runs[-1]['wall']:.2f} s, median {median['wall']:.2f} s; "
        f"processor {processor[0]:.2f} to {processor[-1]:.2f} s, median {processor[len(runs) // 2]:.2f} s"
    )


if __name__ == "__main__":
    main()
