"""One of two processes of a mesh: `python -m tests.sharding.process RANK PORT [dies]`."""

import os
import signal
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from jaxfx import ThinLens, blur, dof, sharding


def main(rank, port, dies):
    """Compute a batch and rows with the other process; end before that if it is to die."""
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", 2, rank, heartbeat_timeout_seconds=10)
    devices = jax.make_mesh((2,), ("part",))
    spread = NamedSharding(devices, PartitionSpec("part"))
    if dies and rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)

    def placed(array):
        return jax.make_array_from_callback(array.shape, spread, lambda index: array[index])

    rng = np.random.default_rng(0)
    images = rng.uniform(0, 1, (4, 8, 6, 3)).astype(np.float32)
    depths = rng.uniform(1.5, 4, (4, 8, 6)).astype(np.float32)
    lens = ThinLens(0.3, 2.5, 20.0)
    tall = images.reshape(32, 6, 3)
    batch = jax.vmap(lambda image, depth: dof.gather(image, depth, lens, max_coc=6.0))
    smooth = lambda image: blur.gaussian(image, sigma=jnp.float32(1.5), taps=9)
    for function, divided, data in (
        (smooth, sharding.rows(smooth, devices, halo=4), (tall,)),
        (batch, batch, (images, depths)),
    ):
        expected = np.asarray(jax.jit(function)(*data))
        found = jax.jit(divided)(*map(placed, data))
        for shard in found.addressable_shards:
            np.testing.assert_allclose(shard.data, expected[shard.index], rtol=2e-5, atol=1e-6)
    print("equal", flush=True)
    jax.distributed.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), "dies" in sys.argv)
