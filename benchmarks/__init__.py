"""Timings, native peers and charts.

`pytest --benchmark-only benchmarks` times; `python -m benchmarks.NAME` draws a chart.
"""
