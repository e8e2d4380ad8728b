"""Signals leave a block as errors do."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from torchrl_ocwm.signals import ended_by_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ends_with_the_exit_code_of_shells(number: signal.Signals, capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    cleared = []

    @ended_by_signals()
    def work() -> None:
        try:
            os.kill(os.getpid(), number)
            signal.pause()
        finally:
            cleared.append(True)

    with pytest.raises(SystemExit) as end:
        work()
    assert end.value.code == 128 + number
    assert cleared
    assert f"stopped by {number.name}" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_other_threads_have_no_signals() -> None:
    seen = []

    def run() -> None:
        with ended_by_signals():
            seen.append(1)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen
