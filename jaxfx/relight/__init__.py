"""Relighting: a deep frame buffer shaded again whenever a light changes."""

from jaxfx._choice import Choice
from jaxfx.relight.choose import choose
from jaxfx.relight.holes import fill_holes
from jaxfx.relight.indirect import indirect
from jaxfx.relight.normals import capture_normals
from jaxfx.relight.shading import render, shade
from jaxfx.relight.state import RelightState, start
from jaxfx.relight.synthesize import Synthesis, synthesize


__all__ = [
    "Choice",
    "RelightState",
    "Synthesis",
    "capture_normals",
    "choose",
    "fill_holes",
    "indirect",
    "render",
    "shade",
    "start",
    "synthesize",
]
