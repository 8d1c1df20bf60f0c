"""Do the tests notice when the product breaks?

    python -m experiments.studies.mutations

Each of the wrong edits of ``mutations.json`` is made in a copy of the repository, one at a time, and the tests
that concern the edited module are run there. Expected: for every edit one of them fails, which passes without it.
An edit whose text no longer occurs exactly once is refused: adapt it to the new code.
About a quarter of an hour on one core. Edits named ``fix_...`` take a mended defect back.
"""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.script import run_script, save

ROOT = Path(__file__).parents[2]


@dataclasses.dataclass(frozen=True)
class Args:
    """Which edits, and where to."""

    only: tuple[str, ...] = ()
    """Names of edits; default: all."""
    out: Path = Path("experiments/results/mutations.json")
    """Where the figures go."""


@dataclasses.dataclass(frozen=True)
class Edit:
    """A wrong edit of one file."""

    name: str
    file: str
    find: str
    """Occurs exactly once in the file."""
    replace: str
    tests: tuple[str, ...]
    """What pytest is given."""


def copy_repository(copy: Path) -> None:
    """The tracked files as they are now, and the cache of compiled programs."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, tracked.stdout.split("\0")):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy / name)
    (ROOT / ".cache").mkdir(exist_ok=True)
    (copy / ".cache").symlink_to(ROOT / ".cache")


def failed_test(copy: Path, tests: Sequence[str]) -> str | None:
    """The first test that fails in the copy, None where all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    ran = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+::.+?)(?: - .*)?$", ran.stdout, re.MULTILINE)
    if ran.returncode and not failed:
        raise RuntimeError(f"{' '.join(command)}: exit code {ran.returncode}:\n{ran.stdout[-3000:]}{ran.stderr}")
    return failed[1] if failed else None


def main(args: Args) -> None:
    """Copy, make each edit, run its tests, take it back."""
    entries = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
    edits = [Edit(**entry) for entry in entries if not args.only or entry["name"] in args.only]
    if len(edits) < len(args.only):
        raise ValueError(f"--only: got {args.only}, expected some of {', '.join(e['name'] for e in entries)}")
    for edit in edits:
        if (found := (ROOT / edit.file).read_text(encoding="utf-8").count(edit.find)) != 1:
            raise ValueError(f"{edit.name}: {edit.file}: got {found} of {edit.find!r}, expected one")
    records = []
    with tempfile.TemporaryDirectory() as folder:
        copy_repository(copy := Path(folder))
        for edit in edits:
            file, began = copy / edit.file, time.monotonic()
            sound = file.read_text(encoding="utf-8")
            file.write_text(sound.replace(edit.find, edit.replace), encoding="utf-8")
            test = failed_test(copy, edit.tests)
            seconds = round(time.monotonic() - began, 1)
            file.write_text(sound, encoding="utf-8")
            if test and failed_test(copy, [test]):
                raise ValueError(f"{edit.name}: {test}: fails without the edit too, expected it to pass")
            records.append({"name": edit.name, "file": edit.file, "caught_by": test, "seconds": seconds})
            print(f"{edit.name:30} {seconds:6} s  {test or 'SURVIVED'}", flush=True)
    survivors = [record["name"] for record in records if record["caught_by"] is None]
    save({"edits": records}, args.out, f"{len(records) - len(survivors)} of {len(records)} edits were caught")
    if survivors:
        raise ValueError(f"survived: {', '.join(survivors)}; expected none")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
