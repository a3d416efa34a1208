"""Evidence reports: one file that says what was shown, what was not, and how to repeat it."""

from verifai_jax.reports.document import write_report as write_report
from verifai_jax.reports.widget import explore as explore
