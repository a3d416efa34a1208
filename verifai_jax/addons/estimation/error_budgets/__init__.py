"""The error of a probability, split into parts: `vj.error_budget`."""

from verifai_jax.addons.estimation.error_budgets._error_budget import error_budget as error_budget
from verifai_jax.addons.estimation.error_budgets.result import ErrorBudget as ErrorBudget
from verifai_jax.addons.estimation.error_budgets.result import ErrorPart as ErrorPart
