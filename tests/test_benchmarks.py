"""The table of `benchmarks/devices.py`, as far as it can be had without an accelerator."""

import json

import numpy as np
import pytest

from benchmarks import devices


def test_it_says_that_there_is_no_accelerator(capsys, monkeypatch):
    monkeypatch.setattr(devices, "accelerator", lambda: None)
    assert devices.main([]) is None
    assert "no accelerator" in capsys.readouterr().out


@pytest.mark.parametrize(
    "only", ["pcf 7", "one edit", pytest.param("", marks=pytest.mark.full)]
)
def test_its_rows_run(only, tmp_path, capsys):
    path = tmp_path / "devices.json"
    found = devices.main(["--cpu", "--side", "16", "--only", only, "--out", str(path)])
    assert not [row["fault"] for row in found["rows"] if "fault" in row]
    assert len(found["rows"]) >= (1 if only else 23)
    assert all(row["ms"] > 0 for row in found["rows"])
    assert json.loads(path.read_text())["rows"] == json.loads(json.dumps(found["rows"]))
    printed = capsys.readouterr().out
    assert all(row["effect"] in printed for row in found["rows"])


def test_what_differs_is_counted():
    expected = np.array([0.0, 1000.0, np.nan, np.inf])
    found = np.array([0.5, 1000.0, np.nan, -np.inf])
    assert devices.share_that_differs([found], [expected]) == 0.25
    assert devices.share_that_differs([found + 2], [expected]) == 0.75
