"""Relighting: a deep frame buffer shaded again whenever a light changes."""

from jaxfx.relight.holes import fill_holes
from jaxfx.relight.indirect import indirect
from jaxfx.relight.normals import capture_normals
from jaxfx.relight.shading import render, shade
from jaxfx.relight.state import RelightState, start
from jaxfx.relight.synthesize import best_caches, synthesize


__all__ = [
    "RelightState",
    "best_caches",
    "capture_normals",
    "fill_holes",
    "indirect",
    "render",
    "shade",
    "start",
    "synthesize",
]
