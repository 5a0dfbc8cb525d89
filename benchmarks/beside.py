"""Compare the step of this checkout with another one: `python benchmarks/beside.py OTHER [--profile NAME ...]`.

Each has a process of its own; they measure in turns, a few hundredths of a second each, so that what else the machine
does meets both. Processor time of the thread; the ratio is the median over single turns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median, quantiles

HERE = Path(__file__).resolve().parents[1]
STEPS = {10: 150, 100: 60, 800: 12}
"""Steps of one turn, by the number of objects."""

WARM = 10


def serve(tree: Path, profile: str) -> None:
    """Time steps of one checkout: for each number of objects on stdin, milliseconds on stdout, least and median."""
    sys.path[:0] = [str(tree), str(tree / "benchmarks")]
    import settled  # noqa: PLC0415 - of the checkout that is measured

    import optipmb  # noqa: PLC0415 - the same

    if not (optipmb.__file__ or "").startswith(str(tree)):
        raise RuntimeError(f"{optipmb.__file__} is not in {tree}")
    settled.PARAMETERS = optipmb.load_profile(profile)
    scenes = {objects: settled.settled(objects) for objects in STEPS}
    for tracker, density, frame in scenes.values():
        for _ in range(WARM):
            tracker.step(density, frame)
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        tracker, density, frame = scenes[int(line)]
        took = []
        for _ in range(STEPS[int(line)]):
            began_ns = time.thread_time_ns()
            tracker.step(density, frame)
            took.append((time.thread_time_ns() - began_ns) / 1e6)
        print(json.dumps([min(took), median(took)]), flush=True)


class Side:
    """The process of one checkout."""

    def __init__(self, tree: Path, profile: str) -> None:
        self._process = subprocess.Popen(  # noqa: S603 - it calls itself
            [sys.executable, __file__, str(tree), "--serve", "--profile", profile],
            env=os.environ | {"PYTHONPATH": str(tree)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answer()

    def turn(self, objects: int) -> tuple[float, float]:
        """Return the least and the median time of some steps, ms."""
        if self._process.stdin is None:
            raise RuntimeError("it has no stdin")
        self._process.stdin.write(f"{objects}\n")
        self._process.stdin.flush()
        least, middle = self._answer()
        return least, middle

    def end(self) -> None:
        """End the process."""
        self._process.communicate()

    def _answer(self) -> list[float]:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise RuntimeError(f"a process ended with status {self._process.wait()}")
        answer: list[float] = json.loads(line)
        return answer


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("other", type=Path, help="checkout of another version")
    parser.add_argument("--profile", nargs="+", default=["generic", "kitti"], help="profiles, the default one first")
    parser.add_argument("--turns", type=int, default=60)
    parser.add_argument("--serve", action="store_true", help="one side, which calls itself so")
    options = parser.parse_args()
    if options.serve:
        serve(options.other, *options.profile)
        return
    print("| profile | objects | other, least ms | this | median ms | this | ratio of turns | quartiles |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
    for profile in options.profile:
        other, this = sides = Side(options.other.resolve(), profile), Side(HERE, profile)
        for objects in STEPS:
            turns = []
            for turn in range(options.turns):
                first, second = (other, this) if turn % 2 else (this, other)
                taken = {first: first.turn(objects), second: second.turn(objects)}
                turns.append((*taken[other], *taken[this]))
            least, middle, this_least, this_middle = zip(*turns, strict=True)
            low, ratio, high = quantiles(b / a for a, b in zip(middle, this_middle, strict=True))
            times = (min(least), min(this_least), median(middle), median(this_middle))
            shown = " | ".join(f"{one:.4f}" for one in times)
            print(f"| {profile} | {objects} | {shown} | {ratio:.3f} | {low:.3f} to {high:.3f} |")
        for side in sides:
            side.end()


if __name__ == "__main__":
    main()
