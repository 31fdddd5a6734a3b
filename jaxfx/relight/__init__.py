"""Relighting: a deep frame buffer shaded again whenever a light changes."""

from jaxfx.relight.shading import render, shade


__all__ = ["render", "shade"]
