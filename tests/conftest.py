"""Settings that every test runs under: float64, two CPU devices, and reuse of random keys as an error."""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_debug_key_reuse", True)
