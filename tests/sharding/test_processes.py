"""A batch and rows on two processes of one machine, which the tests start and end."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest


# Seconds that two processes have to start, compile and compute.
LIMIT = 60


def run_two(*options):
    """Exit codes and outputs of both processes, and seconds; neither is left behind."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    env = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=1"}
    start = time.monotonic()
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.sharding.process", str(rank), str(port), *options],
            cwd=Path(__file__).parents[2],
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        outputs = [process.communicate(timeout=LIMIT)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return [process.returncode for process in processes], outputs, time.monotonic() - start


@pytest.mark.full
def test_two_processes_compute_what_one_does():
    codes, outputs, _ = run_two()
    assert codes == [0, 0], outputs
    assert all("equal" in output for output in outputs)


@pytest.mark.full
def test_a_process_that_dies_is_an_error_of_the_other():
    codes, outputs, _ = run_two("dies")
    assert codes[1] == 3
    assert codes[0] != 0, outputs
    assert "equal" not in outputs[0]
