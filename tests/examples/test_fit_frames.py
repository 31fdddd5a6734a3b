"""One lens of many frames, found on four devices."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest


EXAMPLE = Path(__file__).parents[2] / "examples" / "fit_frames.py"


def found(count):
    """Value, standard error and true value of both parameters."""
    env = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, EXAMPLE, "--frames", str(count)]
    result = subprocess.run(command, check=True, capture_output=True, text=True, env=env)
    assert "12/12" in result.stderr
    lines = re.findall(r": (\S+) \+- (\S+) \(true (\S+)\)", result.stdout)
    assert len(lines) == 2
    return [tuple(map(float, line)) for line in lines]


def test_standard_errors_fall_with_the_root_of_the_number_of_frames():
    few, many = found(16), found(64)
    for line in (*few, *many):
        value, error, true = line
        assert abs(value - true) < 4 * error
    for (_, before, _), (_, after, _) in zip(few, many, strict=True):
        assert after == pytest.approx(before / 2, rel=0.15)
