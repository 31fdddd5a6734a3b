"""A batch and rows on two processes of one machine, which the tests start and end."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest


# Seconds that two processes have to start, compile and compute.
LIMIT = 60


# Seconds that one has to notice that the other was killed: its heartbeat is 10 seconds.
NOTICED = 30


def run_two(*options):
    """Exit codes and outputs of both processes, and when each had ended; none is left behind.

    Each leads a group of its own, with whatever it has started.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    env = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=1"}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.sharding.process", str(rank), str(port), *options],
            cwd=Path(__file__).parents[2],
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        for rank in range(2)
    ]
    ends = {}
    try:
        limit = time.monotonic() + LIMIT
        while len(ends) < 2 and time.monotonic() < limit:
            for process in processes:
                if process not in ends and process.poll() is not None:
                    ends[process] = time.monotonic()
            time.sleep(0.05)
        assert len(ends) == 2, f"{2 - len(ends)} of 2 processes run for {LIMIT} seconds"
        for process in processes:
            with pytest.raises(ProcessLookupError):
                os.killpg(process.pid, 0)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    outputs = [process.communicate()[0] for process in processes]
    return (
        [process.returncode for process in processes],
        outputs,
        [ends[p] for p in processes],
    )


@pytest.mark.full
def test_two_processes_compute_what_one_does():
    codes, outputs, _ = run_two()
    assert codes == [0, 0], outputs
    assert all("equal" in output for output in outputs)


@pytest.mark.full
def test_a_process_that_dies_is_an_error_of_the_other():
    codes, outputs, (noticed, killed) = run_two("dies")
    assert codes[1] == -signal.SIGKILL
    assert codes[0] != 0, outputs
    assert "equal" not in outputs[0]
    assert noticed - killed < NOTICED
