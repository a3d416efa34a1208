"""Late binding: names that are imported when they are first used.

    plot_replay = lazy_import("verifai_jax.pictures.replay", "plot_replay")
    plot_replay(replay, path)                           # the module is imported now, not before

Results are in a lower room than their pictures and analyses. Their methods use these through
`lazy_import`, so that ordinary imports point downwards and a reader finds every exception by this
name. `attach` does the same for all names of a package.
"""

import gc
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def uncollected() -> Iterator[None]:
    """Return a context, or a decorator, in which garbage collection is suspended.

    Imports and tracing make millions of small objects that live on. The collector would scan all
    of them repeatedly, which takes a fifth of the time.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@uncollected()
def lazy_import(module: str, name: str) -> Any:
    """Import `module` now and return its object `name`, which may be a submodule."""
    return getattr(__import__(module, fromlist=[name]), name)


def attach(
    package: str, *others: str, group: str | None = None, classes: bool = False
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose names are imported lazily.

    The names are those that the package imports for type checkers, as `from a.b import c as c`.
    They are read from its source, so that each is written only once.

    **Arguments:**
    - `package`: the name of the package that is being imported.
    - `others`: further names that it already has.
    - `group`: a group of entry points by which other packages add names; see `extensions`.
    - `classes`: whether these are the names of the classes, instead of those of the entries.
    """
    source = sys.modules[package].__loader__.get_source(package)  # pyright: ignore
    begin = source.index("if TYPE_CHECKING:")
    imports = re.findall(r"    from (\S+) import ([^(\n]+|\([^)]*\))\n", source[begin:])
    module_of = {
        name: module for module, names in imports for name in re.findall(r"(\w+) as", names)
    }
    known = [*others, *module_of]

    def added() -> dict[str, str]:
        from verifai_jax.core.display.extensions import entries

        return {} if group is None else entries(group, classes)

    @uncollected()
    def get(name: str) -> Any:
        if name not in module_of:
            from verifai_jax.core.display.extensions import extension
            from verifai_jax.core.messages.errors import nearest_names

            found = {} if name.startswith("_") else added()
            if name not in found:
                near = nearest_names(name, [*known, *found])
                raise AttributeError(f"{package} has no {name!r}{near}")
            return extension(str(group), found[name])
        module = module_of[name]
        if module == package:
            value = importlib.import_module(f"{package}.{name}")
        else:
            try:
                value = lazy_import(module, name)
            except ModuleNotFoundError as error:
                if error.name is None or not f"{module}.".startswith(f"{error.name}."):
                    raise
                raise AttributeError(
                    f"{package}.{name} belongs to {module}, an add-on whose files are missing"
                ) from error
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*known, *added()}), known
