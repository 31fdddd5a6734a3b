"""Relighting: a deep frame buffer (`GBuffer`) shaded again whenever a light changes.

| I want | call |
|---|---|
| an image under some lights | `render(gbuffer, camera, lights, visibilities=...)` |
| the image under one light alone | `shade(gbuffer, camera, light, visibility)` |
| edits of one light among ten or more | `start(...)`, then `.edit(i, light)` |
| edits of materials | `start(...)`, then `.paint(mask, diffuse=...)` |
| one diffuse bounce, or several | `indirect(gbuffer, scene.transfer(...), lights)` |
| what mirrors and glass show | `mirrored` or `refracted`, `scene.gbuffer_along`, `fresnel` |
| a `GBuffer` for a new camera, made of others | `synthesize(gbuffers, cameras, target, ...)` |
| then its holes filled | `fill_holes(gbuffer, views)` |
| to know which of many caches to use for it | `choose(gbuffers, cameras, target, ...)` |
| normals from a renderer that has no such output | `capture_normals(render)` |
| the quickest image within an error | `jaxfx.budget.relight(..., max_error=...)` |
| lights that match a photograph | `jaxfx.fit.lights(...)` |

Shadows are visibilities, height width in [0, 1], one per light: see `jaxfx.shadow`.
`synthesize(weighting="equal")`, the default, is the published mean; `"detail"` is our own and
favours near, frontal caches.
"""

from jaxfx._choice import Choice
from jaxfx.relight.choose import choose
from jaxfx.relight.holes import FilledCache, fill_holes
from jaxfx.relight.indirect import indirect
from jaxfx.relight.normals import capture_normals
from jaxfx.relight.rays import fresnel, mirrored, refracted
from jaxfx.relight.shading import render, shade
from jaxfx.relight.state import RelightState, start
from jaxfx.relight.synthesize import Synthesis, synthesize


__all__ = [
    "Choice",
    "FilledCache",
    "RelightState",
    "Synthesis",
    "capture_normals",
    "choose",
    "fill_holes",
    "fresnel",
    "indirect",
    "mirrored",
    "refracted",
    "render",
    "shade",
    "start",
    "synthesize",
]
