"""Prints the test files that a change touches: `python tests/changed.py [BASE]` for `make check`.

A changed test file stands for itself. A changed module `imutool/ROOM/NAME.py` stands for `tests/ROOM/test_NAME.py`, or, where
no file has that name, for the files of `tests/ROOM` that import it. The base is where the branch left `origin/main`, else HEAD.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ALWAYS = ROOT / "tests" / "test_house.py"


def git(*words: str) -> list[str]:
    """The lines that git prints; none where it refuses."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    return done.stdout.splitlines() if done.returncode == 0 else []


def changed(base: str) -> list[Path]:
    """Python files that differ from `base`, untracked ones included, as far as they still exist."""
    names = git("diff", "--name-only", base) + git("ls-files", "--others", "--exclude-standard")
    paths = [ROOT / name for name in dict.fromkeys(names)]
    return [path for path in paths if path.suffix == ".py" and path.is_file()]


def tests_of(path: Path) -> list[Path]:
    """The test files of one changed file."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "tests":
        return [path] if path.name.startswith("test_") else []
    room = ROOT.joinpath("tests", *(parts[1:-1] if parts[0] == "imutool" else parts[:-1]))
    mirrored = room / f"test_{path.stem}.py"
    if mirrored.is_file():
        return [mirrored]
    dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    package, _, name = dotted.rpartition(".")
    texts = {test: test.read_text(encoding="utf-8") for test in sorted(room.glob("test_*.py"))}
    return [test for test, text in texts.items() if dotted in text or (f"from {package} import" in text and name in text)]


def main() -> None:
    """Prints the files, one a line."""
    base = sys.argv[1] if len(sys.argv) > 1 else next(iter(git("merge-base", "HEAD", "origin/main")), "HEAD")
    found = {test for path in changed(base) for test in tests_of(path)} | {ALWAYS}
    print(*(str(test.relative_to(ROOT)) for test in sorted(found)), sep="\n")


if __name__ == "__main__":
    main()
