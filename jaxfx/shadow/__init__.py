"""Shadows: visibility of a light by comparing depths with a shadow map, and its filters."""

from jaxfx.shadow.cameras import light_cameras
from jaxfx.shadow.edge import Candidates, candidates, edge_pcf
from jaxfx.shadow.moving_shadow import MovingShadow
from jaxfx.shadow.pcf import hard, pcf, prefiltered
from jaxfx.shadow.pcss import pcss
from jaxfx.shadow.receivers import Receivers, receivers
from jaxfx.shadow.variance import variance


__all__ = [
    "Candidates",
    "MovingShadow",
    "Receivers",
    "candidates",
    "edge_pcf",
    "hard",
    "light_cameras",
    "pcf",
    "pcss",
    "prefiltered",
    "receivers",
    "variance",
]
