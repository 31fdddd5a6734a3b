"""Shadows: visibility of a light by comparing depths with a shadow map, and its filters."""

from jaxfx.shadow.pcf import hard, pcf, prefiltered
from jaxfx.shadow.receivers import Receivers, receivers


__all__ = ["Receivers", "hard", "pcf", "prefiltered", "receivers"]
