"""Parameters of the effects from pictures, by optimistix."""

import functools as ft
import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree
from tqdm.auto import tqdm

from jaxfx._numerics import check, check_depth, check_image, parameter
from jaxfx.dof.scatter import largest_coc, scatter
from jaxfx.lens import ThinLens


PARAMETERS = ("aperture", "focus_distance", "gamma", "epsilon")
# Start values of zero have no logarithm.
_SMALLEST = 1e-6
_EPSILON_RESTARTS = (2.0, 0.5)


@final
class DofFit(eqx.Module):
    """What `dof` found.

    - `lens`, `gamma`, `epsilon`: the fitted parameters; frozen ones as they were given.
    - `image`: height width channel, `scatter` with them.
    - `losses`: the mean squared residual at the start and after every step; it rises where
      the search starts again.
    - `uncertainty`: a standard error for each fitted parameter, in its own unit, as if the
      residuals were independent: they are not, so compare the numbers with one another. A
      parameter that the picture can't tell has a large one, or inf.
    - `result`: optimistix' verdict.
    """

    lens: ThinLens
    gamma: Float[Array, ""]
    epsilon: Float[Array, ""]
    image: Float[Array, "height width channel"]
    losses: Float[Array, " steps"]
    uncertainty: dict[str, Float[Array, ""]]
    result: optx.RESULTS

    @property
    def success(self) -> bool:
        """Whether the solver converged."""
        return bool(self.result == optx.RESULTS.successful)


def dof(
    reference: Float[ArrayLike, "height width channel"],
    image: Float[ArrayLike, "height width channel"],
    depth: Float[ArrayLike, "height width"],
    lens: ThinLens,
    *,
    gamma: Float[ArrayLike, ""] | float = 1.0,
    epsilon: Float[ArrayLike, ""] | float = 2.0,
    max_coc: int | float | None = None,
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | None = None,
    parameters: Collection[str] = PARAMETERS,
    max_steps: int = 64,
    throw: bool = True,
    progress: bool = True,
) -> DofFit:
    """The lens and the amplifications that make `dof.scatter` look most like a reference.

    Least squares over all pixels and channels. Aperture, focus distance and epsilon are
    searched by their logarithms and gamma by its inverse softplus, so that each stays positive.
    The squares have local minima in epsilon: from the solution the search starts again with
    half and with twice its epsilon, and the best of the three ends is kept.

    **Arguments:**

    - `reference`: height width channel, linear radiance: a photograph or a multi-pass picture.
    - `image`, `depth`: height width channel and height width, as in `dof.scatter`.
    - `lens`: where the search starts, lengths in scene units; `focal_pixels` is never fitted.
    - `gamma`, `epsilon`: where the search starts, no unit and pixels.
    - `max_coc`: static; the largest diameter, in pixels, that the search may use. By default
      twice the start's largest.
    - `solver`: any least-squares solver or minimiser of optimistix; Levenberg-Marquardt by
      default.
    - `parameters`: the names to fit, out of `fit.PARAMETERS`; the others stay as given.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the solver fails; else the failure stands in the result.
    - `progress`: show a bar on stderr.

    **Returns:** a `DofFit`.

    **Raises:** `ValueError` for what `dof.scatter` refuses, for shapes that differ, an unknown
    or empty choice of parameters, a zero aperture to start from, or a reference that is not
    finite. `RuntimeError` where the solver fails and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.
    """
    image = check_image("dof(image)", image)
    reference = check_image("dof(reference)", reference)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    if reference.shape != image.shape:
        raise ValueError(
            f"`dof(reference)` must have the image's shape {image.shape}, "
            f"got {reference.shape}."
        )
    for name, value in (("image", image), ("reference", reference)):
        if not bool(jnp.isfinite(value).all()):
            raise ValueError(f"`dof({name})` must be finite, got a NaN or inf pixel.")
    if not isinstance(lens, ThinLens):
        raise ValueError(f"`dof(lens)` must be a ThinLens, got {type(lens).__name__}.")
    check("dof(lens.aperture)", lens.aperture, lambda v: v > 0, "positive to start a search")
    free = tuple(name for name in PARAMETERS if name in parameters)
    if not free or len(free) != len(parameters):
        raise ValueError(
            f"`dof(parameters=...)` must name some of {PARAMETERS}, got {tuple(parameters)}."
        )

    start = {
        "aperture": lens.aperture,
        "focus_distance": lens.focus_distance,
        "gamma": parameter("dof(gamma=...)", gamma),
        "epsilon": parameter("dof(epsilon=...)", epsilon),
    }
    for name in ("gamma", "epsilon"):
        check(f"dof({name}=...)", start[name], lambda v: v >= 0, "0 or positive")
    start = {name: value.astype(image.dtype) for name, value in start.items()}
    max_coc = 2 * largest_coc("dof", depth, lens) if max_coc is None else max_coc

    def model(values: dict[str, Array]) -> Float[Array, "height width channel"]:
        values = start | values
        lens_ = ThinLens(values["aperture"], values["focus_distance"], lens.focal_pixels)
        options = {"gamma": values["gamma"], "epsilon": values["epsilon"]}
        return scatter(image, depth, lens_, max_coc=max_coc, **options)

    target = reference.astype(image.dtype)
    unknowns = {name: _unconstrain(name, start[name]) for name in free}
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5) if solver is None else solver
    with tqdm(desc="fit", unit="step", disable=not progress, leave=False) as bar:
        solve = _stepper(
            lambda y: model(_constrain_all(y)) - target, unknowns, solver, max_steps, bar
        )
        end = solve(unknowns)
        losses = end.losses
        for factor in _EPSILON_RESTARTS if "epsilon" in free else ():
            epsilon = end.unknowns["epsilon"] + math.log(factor)
            again = solve(end.unknowns | {"epsilon": epsilon})
            losses = losses + again.losses
            if again.result == optx.RESULTS.successful and again.loss < end.loss:
                end = again
    if throw and end.result != optx.RESULTS.successful:
        raise RuntimeError(
            f"`dof` found no fit in {len(losses)} steps, the mean squared residual falling "
            f"from {losses[0]:.3g} to {end.loss:.3g}: {optx.RESULTS[end.result]} "
            "`throw=False` returns what was reached."
        )

    values = _constrain_all(end.unknowns)
    fitted = jax.jit(model)(values)
    uncertainty = _standard_errors(model, values, fitted - target)
    values = start | values
    return DofFit(
        ThinLens(values["aperture"], values["focus_distance"], lens.focal_pixels),
        values["gamma"],
        values["epsilon"],
        fitted,
        jnp.stack(losses),
        uncertainty,
        end.result,
    )


def _unconstrain(name: str, value: Array) -> Array:
    value = jnp.maximum(value, _SMALLEST)
    return value + jnp.log(-jnp.expm1(-value)) if name == "gamma" else jnp.log(value)


def _constrain_all(unknowns: dict[str, Array]) -> dict[str, Array]:
    return {
        name: jax.nn.softplus(value) if name == "gamma" else jnp.exp(value)
        for name, value in unknowns.items()
    }


class _End(NamedTuple):
    """Where a solver stopped, its loss there, all losses on the way, and its verdict."""

    unknowns: PyTree
    loss: float
    losses: list[Array]
    result: optx.RESULTS


def _stepper(
    residual: Callable[[PyTree], Array], example: PyTree, solver: Any, max_steps: int, bar: tqdm
) -> Callable[[PyTree], _End]:
    """A function that takes a start to its end, one step at a time, to keep every loss."""

    def with_loss(y, _):
        out = residual(y)
        loss = jnp.mean(out * out)
        return (loss if isinstance(solver, optx.AbstractMinimiser) else out), loss

    fn = eqx.filter_closure_convert(with_loss, example, None)
    init = ft.partial(solver.init, fn, args=None, options={}, tags=frozenset())
    rest = {"args": None, "options": {}, "tags": frozenset()}
    step = eqx.filter_jit(lambda y, state: solver.step(fn, y, state=state, **rest))
    stop = eqx.filter_jit(lambda y, state: solver.terminate(fn, y, state=state, **rest))
    loss_at = eqx.filter_jit(lambda y: fn(y, None)[1])

    def solve(y: PyTree) -> _End:
        out_struct, loss_struct = fn.out_struct
        state = init(y, f_struct=out_struct, aux_struct=loss_struct)
        losses, verdict = [loss_at(y)], optx.RESULTS.nonlinear_max_steps_reached
        for _ in range(max_steps):
            y, state, _ = step(y, state)
            losses.append(loss_at(y))
            bar.update()
            bar.set_postfix(mse=f"{float(losses[-1]):.3g}")
            done, result = stop(y, state)
            if not bool(jnp.isfinite(losses[-1])):
                result = optx.RESULTS.nonlinear_divergence
            if done or result != optx.RESULTS.successful:
                verdict = result
                break
        return _End(y, float(losses[-1]), losses, verdict)

    return solve


def _standard_errors(
    model: Callable[[dict[str, Array]], Array], values: dict[str, Array], residual: Array
) -> dict[str, Float[Array, ""]]:
    """Square roots of the diagonal of `sigma**2 (J^T J)^-1`, J by forward mode."""
    jacobian = jax.jit(jax.jacfwd(model))(values)
    columns = jnp.stack([jacobian[name].reshape(-1) for name in values], axis=1)
    norms = jnp.linalg.norm(columns, axis=0)
    known = norms > 0
    scaled = columns / jnp.where(known, norms, 1)
    eigenvalues, vectors = jnp.linalg.eigh(scaled.T @ scaled)
    floor = jnp.finfo(columns.dtype).eps
    variance = jnp.sum(vectors**2 / jnp.maximum(eigenvalues, floor), axis=1)
    sigma = jnp.sqrt(jnp.sum(residual**2) / max(residual.size - len(values), 1))
    errors = jnp.where(known, sigma * jnp.sqrt(variance) / norms, jnp.inf)
    return dict(zip(values, errors, strict=True))
