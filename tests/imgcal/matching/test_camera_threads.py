import os
import signal
import threading
import time

import pytest

from imgcal.matching import each_camera


def test_results_are_in_order_and_threads_stay():
    def name(camera):
        time.sleep(0.01)
        return camera, threading.current_thread()

    first, second = each_camera(name, range(6)), each_camera(name, range(6))
    assert [camera for camera, _ in first] == list(range(6))
    threads = {thread for _, thread in first + second}
    assert threading.main_thread() not in threads and len(threads) <= (os.cpu_count() or 1)
    assert all(thread.is_alive() for thread in threads)
    assert each_camera(name, []) == []


def test_what_fails_in_one_camera_fails():
    with pytest.raises(ZeroDivisionError):
        each_camera(lambda camera: 1 / camera, [2, 0, 1])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    each_camera(abs, range(2))
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # threads that never answer
        os._exit(0 if each_camera(abs, [-3, 1]) == [3, 1] else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
