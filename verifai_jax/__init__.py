"""verifai_jax: find inputs that make a closed-loop system break a temporal-logic property."""

__version__ = "0.1.0"
