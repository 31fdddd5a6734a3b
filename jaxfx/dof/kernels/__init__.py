"""The programs that sum sprites: what `dof.scatter`, `layered` and the budgets of both run.

| module | what it does |
|---|---|
| `_taps` | the term of one tap of scatter, and its derivatives, for any sweep over taps |
| `_shift` | a loop over taps, each over the whole image: for small images |
| `_tiles` | the same tile by tile, only as far as each tile's sprites reach |
| `_spans` | small sprites by `_tiles`, all others by the span painter: for large radii |
| `_rows` | for accelerators: all taps of a row in one kernel |
| `_chords` | sprites of the shape of an iris, by taps and by running sums, on any device |
| `_segment_sum` | every tap written out: the oracle |
| `_span_painter` | discs painted by running sums along rows, and the adjoint of that |
| `_slices` | the layers of `layered`, cut into slices that the span painter paints |
| `_compositing` | slices composited from front to back, and the adjoint of that |
| `_layer_rows` | for accelerators: slices in groups, all taps of a row in one kernel |
| `_layer_chords` | slices of sprites of the shape of an iris, on any device |
| `_layers` | `layered`'s sums: the two programs of it, and its tangent and adjoint |
| `_adjoint` | a kernel with an adjoint of its own, as a function that JAX can transform |

`budget` uses `shift`, `tiles` and `spans`; `benchmarks` measure `TILES` and `to_planes` alone.
"""

from jaxfx.dof.kernels._shift import shift
from jaxfx.dof.kernels._spans import spans
from jaxfx.dof.kernels._taps import to_planes
from jaxfx.dof.kernels._tiles import TILES, tiles


__all__ = ["TILES", "shift", "spans", "tiles", "to_planes"]
