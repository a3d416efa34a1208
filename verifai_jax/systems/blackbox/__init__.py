"""Any Python function as a system, in this process or in worker processes."""

from verifai_jax.systems.blackbox._blackbox import BlackBox as BlackBox
from verifai_jax.systems.blackbox._blackbox import blackbox as blackbox
from verifai_jax.systems.blackbox._blackbox import stack_traces as stack_traces
