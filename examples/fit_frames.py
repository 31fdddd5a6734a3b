"""Find the one lens of many frames of a moving camera, together, on all devices there are.

    fit_frames.py --frames 64

The frames are small and made here, blurred by a known lens, with noise. Each step of
Gauss-Newton adds up the normal equations of all frames: with several devices, one all-reduce.
Prints aperture and focus with their standard errors, which fall with the root of the number of
frames.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from tqdm.auto import tqdm

from jaxfx import ThinLens, dof


TRUE = (0.3, 2.5)  # aperture and focus, scene units
START = (0.27, 2.6)  # near enough: further away there are other minima
NOISE = 0.01
SIDE = 16  # pixels
LARGEST_STEP = 0.1  # of a parameter's value


def blurred(parameters, image, depth):
    """A frame as a lens of this aperture and focus shows it."""
    lens = ThinLens(parameters[0], parameters[1], 20.0)
    return dof.scatter(image, depth, lens, max_coc=8.0)


def make_frames(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images, depths and what was seen: textured slopes, past which the camera moves."""
    rng = np.random.default_rng(0)
    images = rng.uniform(0, 1, (count, SIDE, SIDE, 3))
    slope = np.linspace(1.5, 5, SIDE)[None, :, None] + np.linspace(0, 1, count)[:, None, None]
    depths = np.broadcast_to(slope, (count, SIDE, SIDE))
    seen = jax.jit(jax.vmap(blurred, (None, 0, 0)))(jnp.asarray(TRUE), images, depths)
    return images, depths, np.asarray(seen) + rng.normal(0, NOISE, seen.shape)


def normal_equations(parameters, image, depth, seen):
    """Of one frame: the product of the Jacobian with itself and with the residual, flat."""
    residual = lambda p: (blurred(p, image, depth) - seen).reshape(-1)
    error, jacobian = residual(parameters), jax.jacfwd(residual)(parameters)
    return jnp.concatenate([(jacobian.T @ jacobian).reshape(-1), jacobian.T @ error])


def fit(frames: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Aperture and focus, and their standard errors."""
    devices = jax.make_mesh((jax.device_count(),), ("frames",))
    spec, everywhere = PartitionSpec("frames"), PartitionSpec()

    def summed(parameters, *data):
        each = jax.vmap(normal_equations, (None, 0, 0, 0))(parameters, *data)
        return jax.lax.psum(each.sum(axis=0), "frames")

    add_up = jax.jit(
        jax.shard_map(
            summed, mesh=devices, in_specs=(everywhere, spec, spec, spec), out_specs=everywhere
        )
    )
    data = jax.device_put(make_frames(frames), NamedSharding(devices, spec))
    parameters = np.asarray(START)
    squares = np.eye(2)
    for _ in tqdm(range(steps), unit="step"):
        flat = np.asarray(add_up(parameters, *data))
        squares, slope = flat[:4].reshape(2, 2), flat[4:]
        # No further than what a first derivative may say something of.
        most = LARGEST_STEP * parameters
        parameters = parameters - np.clip(np.linalg.solve(squares, slope), -most, most)
    return parameters, NOISE * np.sqrt(np.diag(np.linalg.inv(squares)))


def main() -> None:
    """Read the arguments, fit, and print."""
    parser = argparse.ArgumentParser(description="Find the one lens of many frames.")
    parser.add_argument("--frames", type=int, default=64, help="a multiple of the devices")
    parser.add_argument("--steps", type=int, default=12)
    given = parser.parse_args()
    values, errors = fit(given.frames, given.steps)
    for name, value, error, true in zip(
        ("aperture", "focus"), values, errors, TRUE, strict=True
    ):
        print(f"{name}: {value:.5f} +- {error:.5f} (true {true})")


if __name__ == "__main__":
    main()
