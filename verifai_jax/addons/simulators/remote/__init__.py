"""Other programs and machines as systems, over TCP."""

from verifai_jax.addons.simulators.remote._remote import remote as remote
