#!/usr/bin/env python3
"""Our stages beside a chain of packaged peers, stage by stage, on one recording and in one run.

    chain.py BENCHMARKS RECORDING [--runs 5]

BENCHMARKS is the folder of segmentation_benchmark, hull_benchmark (built with Open3D) and face_scan_benchmark. Peers:
OpenCV's MOG2 with shadows; Open3D's carving of a dense grid, marching cubes of its voxels and its quadric decimation;
where the recording has a face scan, OpenCV's GrayCodePattern and triangulatePoints. Processor time, medians.
"""

import argparse
import json
import os
import subprocess
import sys

STAGES = [
    # stage, program, ours, peer's name, peer
    ("segmentation", "segmentation_benchmark", "run/ours", "MOG2", "run/MOG2"),
    ("masks to mesh", "hull_benchmark", "masks_to_mesh", "Open3D", "open3d_masks_to_mesh"),
    ("Gray codes to points", "face_scan_benchmark", "ours_whole_images", "OpenCV", "opencv"),
]


def seconds_of(program: str, recording: str, runs: int, names: list[str]) -> dict[str, float]:
    """Median processor seconds of an iteration, by the benchmark's name without its options."""
    answer = subprocess.run(
        [program, "--benchmark_format=json", f"--benchmark_repetitions={runs}",
         "--benchmark_filter=^(" + "|".join(names) + ")(/|$)"],
        env=os.environ | {"BOOTH_RECORDING": recording}, stdout=subprocess.PIPE, check=True,
    )
    found: dict[str, list[float]] = {}
    for entry in json.loads(answer.stdout)["benchmarks"]:
        if entry["run_type"] == "iteration":
            for name in names:
                if entry["name"] == name or entry["name"].startswith(name + "/"):
                    found.setdefault(name, []).append(entry["cpu_time"] / 1000)
    return {name: sorted(times)[len(times) // 2] for name, times in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmarks")
    parser.add_argument("recording")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    with open(os.path.join(arguments.recording, "recording.json"), encoding="utf-8") as file:
        has_scan = any(shot["role"] == "gray_code" for shot in json.load(file)["shots"])

    print("| stage | ours | peer | ratio |\n| --- | --- | --- | --- |")
    ours_all = peers_all = 0.0
    for stage, program, ours, peer_name, peer in STAGES:
        if program == "face_scan_benchmark" and not has_scan:
            continue
        times = seconds_of(
            os.path.join(arguments.benchmarks, program), arguments.recording, arguments.runs, [ours, peer]
        )
        if len(times) < 2:
            sys.exit(f"{program} was built without {peer_name}")
        print(f"| {stage} | {times[ours]:.2f} s | {peer_name} {times[peer]:.2f} s | {times[peer] / times[ours]:.1f} |")
        ours_all += times[ours]
        peers_all += times[peer]
    print(f"| all | {ours_all:.2f} s | {peers_all:.2f} s | {peers_all / ours_all:.1f} |")


if __name__ == "__main__":
    main()
