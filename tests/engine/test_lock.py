import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from filelock import FileLock

from jaxba import JaxbaError
from jaxba.engine._lock import holder, locked

HOLD = """
import sys, time
from pathlib import Path
from jaxba.engine._lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path: Path):
    """Another process that holds the project's lock."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_two_runs_refuse_each_other_and_the_message_names_the_one_that_goes_on(other, tmp_path: Path):
    with (
        pytest.raises(JaxbaError, match=rf"another run works on it \(process {other.pid} on .* since .*\); wait"),
        locked(tmp_path),
    ):
        pass
    assert f"process {other.pid} on" in str(holder(tmp_path))


def test_a_look_at_the_holder_does_not_refuse_a_run(tmp_path: Path):
    with locked(tmp_path):
        pass
    looks = FileLock(tmp_path / ".lock", thread_local=False)
    looks.acquire()
    threading.Timer(0.03, looks.release).start()
    with locked(tmp_path):
        assert holder(tmp_path) is not None


def test_what_the_holder_says_survives_every_attempt_of_others(tmp_path: Path):
    with locked(tmp_path):
        for _ in range(2):
            with pytest.raises(JaxbaError, match=rf"process {os.getpid()} on"), locked(tmp_path):
                pass
            assert f"process {os.getpid()} on" in str(holder(tmp_path))


def test_a_folder_that_may_not_be_written_to_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(FileLock, "acquire", refused)
    with pytest.raises(JaxbaError, match=r"\.lock: not written, Permission denied: .* \(--out\)"), locked(tmp_path):
        pass


def test_a_killed_run_locks_nobody_out(other, tmp_path: Path):
    os.kill(other.pid, signal.SIGKILL)
    other.wait()
    assert holder(tmp_path) is None
    with locked(tmp_path):
        assert f"process {os.getpid()} on" in str(holder(tmp_path))
    assert holder(tmp_path) is None


def test_a_project_that_nobody_has_worked_on_has_no_holder(tmp_path: Path):
    assert holder(tmp_path) is None and list(tmp_path.iterdir()) == []
