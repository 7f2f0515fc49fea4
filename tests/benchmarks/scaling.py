#!/usr/bin/env python3
"""How the cost of a job grows with cameras and with pixels.

    scaling.py BOOTH_RECONSTRUCT MAKE_CAPTURE [--runs 5] [--plot FILE.svg]

Makes recordings of a synthetic person (make_capture), reconstructs each several times as job.py does, and prints the
medians and the exponent e of the law cost ~ n^e through them, by least squares. With --plot draws both laws.
"""

import argparse
import math
import os
import pathlib
import subprocess
import tempfile

import job

CAMERAS = [4, 8, 16, 32]
MEGAPIXELS = [1, 2, 5, 12]
OF_CAMERAS_MEGAPIXELS = 2
OF_PIXELS_CAMERAS = 8


def measure(program: str, make: str, cameras: int, megapixels: float, runs: int) -> tuple[float, float, float]:
    """Median processor seconds, wall seconds and memory in MiB of a job, the empty booth learned before."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([make, str(cameras), str(megapixels), folder], check=True)
        command = [program, "--face", "none", "--cache", os.path.join(folder, "cache"), os.path.join(folder, "capture")]
        trace = pathlib.Path(folder, "trace.json")
        job.run_once(command, trace)
        made = [job.run_once(command, trace) for _ in range(runs)]

        def median(of: str) -> float:
            return sorted(run[of] for run in made)[runs // 2]

        return median("processor"), median("wall"), median("memory")


def exponent(points: list[tuple[float, float]]) -> float:
    """Of the law y ~ x^e, by least squares in logarithms."""
    logs = [(math.log(x), math.log(y)) for x, y in points]
    mean_x = sum(x for x, _ in logs) / len(logs)
    mean_y = sum(y for _, y in logs) / len(logs)
    return sum((x - mean_x) * (y - mean_y) for x, y in logs) / sum((x - mean_x) ** 2 for x, _ in logs)


def draw(path: str, laws: list[tuple[str, list[tuple[float, float]]]]) -> None:
    """Both laws side by side, axes from zero, each with the straight line from the origin to its first point."""
    side, margin = 320, 56
    parts = []
    for number, (title, points) in enumerate(laws):
        left = margin + number * (side + 2 * margin)
        x_most, y_most = max(x for x, _ in points), max(y for _, y in points) * 1.1

        def place(x: float, y: float) -> tuple[float, float]:
            return left + x / x_most * side, margin + side - y / y_most * side

        x0, y0 = place(0, 0)
        parts.append(f'<path d="M{x0},{margin} L{x0},{y0} L{x0 + side},{y0}" fill="none" stroke="black"/>')
        parts.append(f'<text x="{x0 + side / 2}" y="{margin - 16}" text-anchor="middle">{title}</text>')
        first_x, first_y = points[0]
        reach = min(x_most, y_most / first_y * first_x)
        end = place(reach, first_y / first_x * reach)
        parts.append(f'<path d="M{x0},{y0} L{end[0]},{end[1]}" stroke="grey" stroke-dasharray="4"/>')
        parts.append(
            '<path fill="none" stroke="steelblue" stroke-width="2" d="M'
            + " L".join("{:.1f},{:.1f}".format(*place(x, y)) for x, y in points) + '"/>'
        )
        for x, y in points:
            at_x, at_y = place(x, y)
            parts.append(f'<circle cx="{at_x:.1f}" cy="{at_y:.1f}" r="4" fill="steelblue"/>')
            parts.append(f'<text x="{at_x:.1f}" y="{y0 + 18}" text-anchor="middle">{x:g}</text>')
            parts.append(f'<text x="{at_x:.1f}" y="{at_y - 10:.1f}" text-anchor="end">{y:.2f} s</text>')
    width, height = 2 * (side + 2 * margin), side + 2 * margin
    pathlib.Path(path).write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" '
        f'font-size="13"><rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="booth-reconstruct")
    parser.add_argument("make", help="make_capture")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--plot", help="an SVG of both laws")
    arguments = parser.parse_args()

    laws = []
    for title, cases in (
        (f"cameras of {OF_CAMERAS_MEGAPIXELS} MP", [(n, n, OF_CAMERAS_MEGAPIXELS) for n in CAMERAS]),
        (f"megapixels of {OF_PIXELS_CAMERAS} cameras", [(m, OF_PIXELS_CAMERAS, m) for m in MEGAPIXELS]),
    ):
        print(f"| {title} | processor | wall | memory |\n| --- | --- | --- | --- |")
        points = []
        for n, cameras, megapixels in cases:
            cpu, wall, memory = measure(arguments.program, arguments.make, cameras, megapixels, arguments.runs)
            points.append((n, cpu))
            print(f"| {n} | {cpu:.2f} s | {wall:.2f} s | {memory:.0f} MiB |", flush=True)
        print(f"\nexponent {exponent(points):.2f}\n")
        laws.append((title, points))
    if arguments.plot:
        draw(arguments.plot, laws)


if __name__ == "__main__":
    main()
