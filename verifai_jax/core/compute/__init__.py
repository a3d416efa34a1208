"""The use of JAX: devices, compilation, keys, precision, identities of programs."""
