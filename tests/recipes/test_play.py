"""``ocwm play`` as a program: it serves, ends with Ctrl-C, and says what it lacks."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest

PLAY = [sys.executable, "-m", "torchrl_ocwm.console", "play"]


def ended(*arguments: str) -> tuple[int, str]:
    done = subprocess.run([*PLAY, *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.slow
def test_it_serves_the_page_until_ctrl_c(tmp_path: Path) -> None:
    pytest.importorskip("gradio")
    with subprocess.Popen(
        [*PLAY, "browser=false"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as program:
        assert program.stdout is not None
        assert program.stderr is not None
        line = program.stdout.readline()
        assert line.startswith("The page is at http://127.0.0.1:"), program.stderr.read()
        assert b"torchrl_ocwm: play" in urlopen(line.split()[4]).read()
        program.send_signal(signal.SIGINT)
        assert program.wait(timeout=60) == 130
        assert "Traceback" not in program.stderr.read()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_agent_that_there_is_not_ends_it_with_one_line() -> None:
    pytest.importorskip("gradio")
    code, said = ended("agent=no_such.zip")
    assert code == 1
    (line,) = said.splitlines()
    assert line.startswith("CheckpointError: no_such.zip: no such checkpoint")


def test_without_gradio_it_says_what_to_install() -> None:
    code = "import sys; sys.modules['gradio'] = None; import torchrl_ocwm.play; import torchrl_ocwm.play.page"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert "the page needs gradio, which is not installed: pip install 'torchrl-ocwm[play]'" in last
