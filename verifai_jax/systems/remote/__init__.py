"""Other programs and machines as systems, over TCP."""

from verifai_jax.systems.remote._remote import remote as remote
