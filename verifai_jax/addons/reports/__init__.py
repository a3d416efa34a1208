"""Evidence reports: one file with the findings, their limits, and the commands to repeat them."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.reports._plain_errors import plain_errors as plain_errors
    from verifai_jax.addons.reports.document import write_report as write_report
    from verifai_jax.addons.reports.widget import explore as explore
# Imported when first used: a folder inside needs few of these names.
__getattr__, __dir__, __all__ = attach(__name__)
