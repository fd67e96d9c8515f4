"""Foreign code that does not end."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from stitch.errors import InputError
from stitch.system.time_limit import running_over, time_limit


def spin(seconds):
    with time_limit(0.3, "too long"):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            pass


@pytest.mark.parametrize("wait", [spin, time.sleep])
def test_what_takes_too_long_is_interrupted(wait):
    began = time.monotonic()
    with pytest.raises(InputError, match="too long"), time_limit(0.3, "too long"):
        wait(30)
    assert time.monotonic() - began < 10 and not running_over()


def test_a_thread_that_takes_too_long_interrupts_who_waits_for_it():
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(spin, 2)
        with pytest.raises(InputError, match="too long"):
            waiting.result()
        assert running_over()
    assert not running_over()


def test_what_ends_in_time_is_left_alone():
    with time_limit(0.5, "outer"):
        with time_limit(0.1, "inner"):
            pass
        time.sleep(0.2)
    time.sleep(0.6)
