"""Tests: each folder mirrors one of `jaxfx`."""
