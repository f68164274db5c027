"""A stop that is asked for by a signal."""

import os
import signal
import threading

import pytest

from fmu.interruption import interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_stops(number, capsys):
    before = signal.getsignal(number)
    with interruptible() as asked:
        assert not asked()
        os.kill(os.getpid(), number)
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert capsys.readouterr().err == "Stopping after the step under way; once more to stop at once.\n"
    assert signal.getsignal(number) is before


def test_within_another_one_both_are_asked():
    with interruptible() as outer:
        with interruptible() as inner:
            os.kill(os.getpid(), signal.SIGINT)
            assert inner()
        assert outer()
    with interruptible() as later:
        assert not later()


def test_in_another_thread_nothing_changes():
    heard = []

    def listen():
        with interruptible() as asked:
            heard.append(asked())

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()
    assert heard == [False]
    assert signal.getsignal(signal.SIGINT) is before
