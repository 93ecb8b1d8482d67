"""The command gym-mara as a process: signals, closed pipes, full disks, terminals of other encodings."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gym_mara import cli
from gym_mara.cli import app
from tests.helpers import started
from tests.robot.arms import TOOL, arm, arm_file

GYM_MARA = ["-m", "gym_mara.cli"]


def _done(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    """The command, once it has ended."""
    return subprocess.run(  # type: ignore[call-overload, no-any-return]
        [sys.executable, *GYM_MARA, *arguments],
        **{"check": False, "text": True, "timeout": 120, "stderr": subprocess.PIPE, **options},
    )


def test_a_warning_is_one_line_without_a_place_in_the_code(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(base="", collision=""))  # it never collides
    options = ["--set", f"robot={urdf}", "--set", f"ee_frame={TOOL}", "--states", "2"]
    done = _done("rewards", "--record", str(tmp_path / "new.csv"), *options)
    assert done.returncode == 0
    assert done.stderr.startswith("warning: ")
    assert ".py" not in done.stderr


@pytest.mark.parametrize(
    ("number", "every", "message"),
    [
        (signal.SIGINT, "1e6", "There is no checkpoint yet"),
        (signal.SIGTERM, "512", "The checkpoint at step"),
        (signal.SIGHUP, "1e6", "There is no checkpoint yet"),
    ],
)
def test_an_interrupted_training_says_what_is_saved(
    tmp_path: Path, number: signal.Signals, every: str, message: str
) -> None:
    run, errors = tmp_path / "run", tmp_path / "errors"
    command = [*GYM_MARA, "train", "--env", "MARAGoal-v0", "--steps", "1e7"]
    command += ["--checkpoint-every", every, "--out", str(run)]
    # A signal that is ignored, as SIGHUP where the tests run under nohup, would stay ignored.
    usual = "default_int_handler" if number == signal.SIGINT else "SIG_DFL"
    code = f"import signal, sys; signal.signal({int(number)}, signal.{usual}); "
    code += f"sys.stderr = open({str(errors)!r}, 'w'); sys.argv = {command[1:]!r}; "
    code += "from gym_mara.cli import main; main()"
    wanted = run / ("config.json" if every == "1e6" else "checkpoints/512")
    with started("-c", code) as training:
        deadline = time.monotonic() + 120
        while not wanted.exists():
            assert training.poll() is None, "the training ended early"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        training.send_signal(number)
        training.communicate(timeout=60)
    text = errors.read_text()
    assert training.returncode == 130, text
    assert text.startswith(f"Interrupted. {message}")
    assert text.count("\n") == 1
    assert f"gym-mara train --resume {run}" in text


def test_an_interrupt_before_the_command_starts_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(arguments: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "run", interrupted)
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 130
    assert capsys.readouterr().err == "Interrupted.\n"


def test_a_fault_of_the_package_is_reported_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(app, "run", lambda arguments: 1 // 0)
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert "ZeroDivisionError" in error
    assert "please report it" in error


@pytest.mark.parametrize("arguments", [["list"], ["--help"], ["train", "--help"]])
def test_a_closed_pipe_ends_the_command_quietly(arguments: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = _done(*arguments, stdout=writer)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (2, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux only")
@pytest.mark.parametrize("arguments", [["list"], ["train", "--help"]])
def test_a_full_disk_under_the_output_is_one_line(arguments: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = _done(*arguments, stdout=full)
    assert done.returncode == 2
    assert done.stderr == "error: cannot write the output: No space left on device\n"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize("arguments", [["list"], ["benchmark", "--help"], ["evaluate", "a±\udcff"]])
def test_the_output_fits_any_encoding(
    monkeypatch: pytest.MonkeyPatch, encoding: str, arguments: list[str]
) -> None:
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    monkeypatch.setattr(sys, "argv", ["gym-mara", *arguments])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == (2 if arguments[0] == "evaluate" else 0)
    for stream in streams.values():
        stream.flush()
        written = stream.buffer.getvalue()  # type: ignore[attr-defined]
        assert b"\x1b" not in written, "no colours where there is no terminal"
        assert b"Traceback" not in written


def test_without_a_stdout_the_command_works() -> None:
    code = "import sys; sys.stdout = None; from gym_mara.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, "list"], check=False, timeout=120)
    assert done.returncode == 0
