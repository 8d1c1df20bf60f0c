"""Check atomic writes and file locks from the view of other processes."""

import contextlib
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from fcos_lidar_jax.files import atomic_write, file_lock, folder_lock, line_writer


def test_atomic_write_replaces_the_whole_file(tmp_path):
    file = tmp_path / "new" / "folder" / "a.pcd.bin"
    atomic_write(file, lambda temporary: temporary.write_text("first"))
    states = []

    def write(temporary):
        temporary.write_text("sec")
        states.append((file.read_text(), temporary.parent, temporary.suffix))
        temporary.write_text("second")

    atomic_write(str(file), write)
    assert states == [("first", file.parent, ".bin")], "the old file remains until the new file is complete"
    assert [(f.name, f.read_text()) for f in file.parent.iterdir()] == [("a.pcd.bin", "second")]
    mask = os.umask(0o022)
    os.umask(mask)
    assert file.stat().st_mode & 0o777 == 0o666 & ~mask, "default permissions"


def test_an_interrupted_write_keeps_the_old_file(tmp_path):
    file = tmp_path / "a.json"
    file.write_text("old")

    def write(temporary):
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        atomic_write(file, write)
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [("a.json", "old")]


def test_only_files_are_replaced(tmp_path):
    (tmp_path / "link").symlink_to("a.json")
    for path, found in (
        (tmp_path, "a folder"),
        (tmp_path / "link", "a link to a.json"),
        ("/dev/null", "a device"),
    ):
        with pytest.raises(FileExistsError, match=f"{path}: found {found}.*, expected a file to write"):
            atomic_write(path, lambda temporary: temporary.write_text(""))


_HOLDER = """
import sys
from fcos_lidar_jax.files import file_lock
with file_lock(sys.argv[1]) as held:
    print(held, flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(file, arguments=""):
    """Start a process that holds the lock of a file until it is killed or its input ends."""
    source = _HOLDER.replace("(sys.argv[1])", f"(sys.argv[1]{arguments})")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", source, str(file)], **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_lock_excludes_other_processes_until_its_holder_is_killed(tmp_path):
    file = tmp_path / "new" / "run.lock"
    with holding(file) as other:
        assert other.stdout.readline() == "True\n"
        with file_lock(file) as held:
            assert not held
    with file_lock(file) as held:
        assert held
    with file_lock(file, wait=True) as held, file_lock(file) as second:
        assert (held, second) == (True, False), "a released lock can be taken again"


def test_waiting_for_a_lock_ends_when_it_is_released(tmp_path):
    with contextlib.ExitStack() as first:
        assert first.enter_context(file_lock(tmp_path / "run.lock"))
        with holding(tmp_path / "run.lock", ", wait=True") as second:
            second.stdin.close()
            with pytest.raises(subprocess.TimeoutExpired):
                second.wait(1)
            first.close()
            assert second.stdout.read() == "True\n"


def test_a_folder_lock_excludes_its_holder_other_threads_and_processes(tmp_path):
    with folder_lock(tmp_path, "writing"), ThreadPoolExecutor() as pool:
        for another in (folder_lock(tmp_path, "x"), folder_lock(tmp_path / "." / "", "x")):
            with pytest.raises(BlockingIOError, match=rf"in use: process {os.getpid()} on .* is writing, exp"):
                pool.submit(another.__enter__).result()
        with pytest.raises(BlockingIOError, match="is writing"), folder_lock(tmp_path, "reading"):
            pass
        with holding(tmp_path / ".lock") as other:
            assert other.stdout.readline() == "False\n"
    assert (tmp_path / ".lock").read_text() == ""
    with holding(tmp_path / ".lock") as other:
        assert other.stdout.readline() == "True\n"
        (tmp_path / ".lock").write_text("process 1\x00" * 1000)
        with pytest.raises(BlockingIOError) as caught, folder_lock(tmp_path, "x"):
            pass
        assert len(str(caught.value)) < 200 + 2 * len(str(tmp_path)) + 60


FULL = """
import resource, sys
from pathlib import Path
from fcos_lidar_jax.files import line_writer
resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500))  # writes beyond 1,500 bytes fail, as on a full disk
with line_writer(Path(sys.argv[1])) as write_line:
    for _ in range(2):
        write_line(1000 * b"x")
"""


def test_a_full_disk_leaves_whole_lines_and_is_reported(tmp_path):
    """Only a part of the second line fits."""
    file = tmp_path / "a.jsonl"
    done = subprocess.run([sys.executable, "-c", FULL, file], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"{file}: cannot be written: File too large" in done.stderr
    assert file.read_bytes() == 1000 * b"x" + b"\n"


def test_a_second_line_writer_of_a_file_is_rejected(tmp_path):
    file = tmp_path / "a.jsonl"
    file.write_text("old\n")
    with line_writer(file) as write_line:
        write_line(b"1")
        with pytest.raises(BlockingIOError, match=r"a\.jsonl: in use: another process"), line_writer(file):
            pass
        write_line(b"2")
    assert [json.loads(line) for line in file.read_text().splitlines()] == [1, 2]
