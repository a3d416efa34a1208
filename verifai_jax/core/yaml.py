"""YAML of files that may come from anywhere."""

from verifai_jax.core.errors import require


def read_yaml(text: str) -> object:
    """Read YAML without tags of Python.

    **Raises:** `ValueError` for anything else; `MissingExtra` without PyYAML.
    """
    yaml = require("yaml", "yaml")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def write_yaml(value: object) -> str:
    """Return YAML that `read_yaml` reads again."""
    return require("yaml", "yaml").safe_dump(value, sort_keys=False, allow_unicode=True)
