"""User-defined estimators and tasks, named `module:name`."""

import importlib
import inspect
import sys
import traceback
from collections.abc import Generator
from contextlib import contextmanager, suppress
from operator import attrgetter
from pathlib import Path

from estimators.user_inputs import observing


class MissingModuleError(ValueError):
    """The module of a `module:name` cannot be found."""


def find_attribute(qualified_name: str, noun: str, kind: type) -> object:
    """Return the object of a `module:name`.

    Args:
        noun: Name of the object in messages.
        kind: Type of object whose names an error lists, besides the module's own functions and classes.

    Raises:
        MissingModuleError: The module does not exist.
        ValueError: Importing the module raises, or it lacks the name; the message lists its names.
    """
    module, _, name = qualified_name.partition(":")
    if not all(part.isidentifier() for part in module.split(".")) or module.endswith(".py"):
        raise MissingModuleError(f"{module!r} is not a module name: write it as in an import, without a folder or .py")
    importlib.invalidate_caches()
    try:
        with observing(module):
            loaded = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            raise MissingModuleError(f"there is no module {error.name!r} here or installed") from error
        raise ValueError(f"importing {module} raised {describe_error(error)}") from error
    try:
        return attrgetter(name)(loaded)
    except AttributeError:
        defined = [
            label
            for label, value in vars(loaded).items()
            if isinstance(value, kind)
            or ((inspect.isfunction(value) or inspect.isclass(value)) and value.__module__ == loaded.__name__)
        ]
        raise ValueError(f"{module} has no {name!r}; it has {', '.join(defined) or f'no {noun}'}") from None


def describe_error(error: BaseException) -> str:
    """Format an error's type and message in one line, with the innermost line of user code in its traceback."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    caught, *frames = traceback.extract_tb(error.__traceback__)
    internal = (str(Path(caught.filename).parent), importlib.__file__, "<frozen importlib")
    frames = [frame for frame in frames if not frame.filename.startswith(internal)]
    if not frames:
        return text
    last = [frame for frame in frames if frame.filename == frames[0].filename][-1]
    return f"{text} ({Path(last.filename).name}, line {last.lineno})"


@contextmanager
def importable_here() -> Generator[None]:
    """Put the current directory first on the module search path, as `python -m` does."""
    here = str(Path.cwd())
    if here in sys.path or "" in sys.path:
        yield
        return
    sys.path.insert(0, here)
    try:
        yield
    finally:
        with suppress(ValueError):
            sys.path.remove(here)
