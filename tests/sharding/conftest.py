import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest


# Eight devices of one CPU. In jaxlib 0.10 older emitters of kernels compile in a third to half
# of the time, and what is tested is where kernels run; later releases have none.
FLAGS = "--xla_force_host_platform_device_count=8"
if jax.__version_info__ < (0, 11):
    FLAGS += " --xla_cpu_use_fusion_emitters=false"


@pytest.fixture(scope="session")
def eight_devices():
    """A function that asks a process with eight devices: a check's name and its arguments."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.sharding.worker"],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "XLA_FLAGS": FLAGS},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

    questions, answers = process.stdin, process.stdout
    assert questions and answers

    def ask(check, **arguments):
        print(json.dumps({"check": check, **arguments}), file=questions, flush=True)
        for line in answers:
            if line.startswith("answer "):
                answer = json.loads(line.removeprefix("answer "))
                assert "failed" not in answer, answer["failed"]
                return answer
        raise AssertionError(f"the process with eight devices ended: {process.wait()}")

    yield ask
    process.communicate(timeout=60)
