"""A stop that is asked for by a signal."""

import os
import signal
import threading
import time

import pytest

from fmu.interruption import interruptible, shielded, stoppable


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_stops(number, capsys):
    before = signal.getsignal(number)
    with interruptible() as asked:
        assert not asked()
        os.kill(os.getpid(), number)
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert capsys.readouterr().err == "Stopping after the current step; interrupt again to stop at once.\n"
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_elsewhere_the_first_stops_at_once(number):
    with stoppable():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        with interruptible():
            pass
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)


def test_what_must_be_whole_is_finished_first():
    done = []

    def work():
        with shielded():
            with shielded():
                os.kill(os.getpid(), signal.SIGTERM)
            done.append(1)
        done.append(2)

    with stoppable(), pytest.raises(KeyboardInterrupt):
        work()
    assert done == [1]


def test_a_step_that_takes_long_is_interrupted(monkeypatch, capsys):
    monkeypatch.setattr("fmu.interruption.GRACE_S", 0.05)
    before = signal.getsignal(signal.SIGALRM)
    with interruptible() as asked:
        os.kill(os.getpid(), signal.SIGINT)
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            time.sleep(5.0)
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert capsys.readouterr().err.count("\n") == 1


def test_a_step_that_ends_in_time_is_not(monkeypatch):
    monkeypatch.setattr("fmu.interruption.GRACE_S", 0.05)
    with stoppable():
        with interruptible():
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)


def test_a_signal_in_a_shielded_block_that_fails_is_not_lost():
    def fail():
        with shielded():
            os.kill(os.getpid(), signal.SIGINT)
            raise ValueError

    with stoppable(), pytest.raises(KeyboardInterrupt):
        fail()
