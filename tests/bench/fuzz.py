"""Broken inputs of every kind: `python tests/bench/fuzz.py [KIND...] [--seconds 3600] [--seed S] [--case N]`, problems found.

The kinds are the modules of `tests/fuzz`. Without a seed it is the date of the day. With `KIND:CASES` so many of a kind run,
however long that takes; with `--case` that case alone runs again.
Exit code 1 if a promise was broken.
"""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

import fuzz  # noqa: E402  # found by the line above

MAX_PROBLEMS = 20  # of one kind, then the search for it ends


def main() -> int:
    """Runs the cases and prints what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND[:CASES]", help=", ".join(fuzz.kinds()))
    parser.add_argument("--seconds", type=float, default=60.0, help="in all, divided over the kinds")
    parser.add_argument("--seed", default=datetime.datetime.now(datetime.UTC).date().isoformat())
    parser.add_argument("--case", type=int, help="run this case alone")
    given = parser.parse_args()
    broken = 0
    chosen = given.kinds or fuzz.kinds()
    for kind, _, count in (word.partition(":") for word in chosen):
        if given.case is not None:
            each = iter([fuzz.run_case(kind, given.seed, given.case)])
        elif count:
            each = (fuzz.run_case(kind, given.seed, number) for number in range(int(count)))
        else:
            each = fuzz.hunt(kind, given.seed, given.seconds / len(chosen))
        cases = problems = 0
        for found in each:
            cases, problems = cases + 1, problems + len(found)
            for line in found:
                print(line, flush=True)
            if problems >= MAX_PROBLEMS:
                break
        broken += problems
        print(f"{kind}: seed {given.seed}, {cases} cases, {problems} problems", flush=True)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
