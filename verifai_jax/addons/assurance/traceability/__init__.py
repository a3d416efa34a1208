"""The chain from requirements to reports, link by link: `vj.trace_matrix`."""

from verifai_jax.addons.assurance.traceability._trace_matrix import trace_matrix as trace_matrix
from verifai_jax.addons.assurance.traceability.result import Gap as Gap
from verifai_jax.addons.assurance.traceability.result import Result as Result
from verifai_jax.addons.assurance.traceability.result import TraceMatrix as TraceMatrix
from verifai_jax.addons.assurance.traceability.result import TraceRow as TraceRow
