"""Source files of the user's code: of modules, and of the neighbouring ones that they import, loaded or not.

Code of this package, of the libraries below it and of the standard library is identified by version instead.
"""

import ast
import functools
import hashlib
import sys
import types
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Final

from estimators.user_inputs import INSTALLED

BY_VERSION: Final = {"mjx_study", "estimators", "mujoco", "jax", "jaxlib", "numpy", "scipy", "optax", "builtins"}
"""Modules whose code is identified by version."""


class Sources:
    """Digests of source files, each with the neighbouring files that it imports, at the top or within functions.

    Attributes:
        digests: of each file, by its path relative to the folder from which it was imported.
        foreign: whether there is any code from outside this package, including that of an interactive session.
    """

    def __init__(self) -> None:
        self.digests: dict[str, str] = {}
        self.foreign = False

    def add(self, module: str) -> None:
        """Add the source file of a module, and of neighbouring modules that it imports."""
        path = source_file(module)
        self.foreign |= not by_version(module)
        if by_version(module) or path is None:
            return
        levels = module.count(".") + (path.name == "__init__.py")
        root = path.parents[min(levels, len(path.parents) - 1)]
        if self._read(path, root):
            for value in list(vars(sys.modules[module]).values()):
                other = value.__name__ if isinstance(value, types.ModuleType) else getattr(value, "__module__", None)
                loaded = isinstance(value, types.ModuleType) and str(other).startswith(f"{module}.")
                if loaded and is_users(module):  # by anybody; what the package itself imports follows
                    continue
                if isinstance(other, str) and _is_neighbour(other, module, root):
                    self.add(other)
            if is_users(module):
                self._imported(path, root, module)

    def _read(self, path: Path, root: Path) -> bool:
        """Add a source file; whether it is a new one."""
        name = str(path.relative_to(root))
        if new := name not in self.digests:
            self.digests[name] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        return new

    def _imported(self, path: Path, root: Path, module: str) -> None:
        """Add the files that import statements of a file name, wherever they stand, whether or not they are loaded."""
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        for name in sorted(imports(path.read_bytes(), package)):
            place = root.joinpath(*name.split("."))
            for found in (place.with_suffix(".py"), place / "__init__.py"):
                if by_version(name) or not found.is_file():
                    continue
                if source_file(name) == found:
                    self.add(name)
                elif self._read(found, root):
                    self._imported(found, root, name)


def by_version(module: str) -> bool:
    top = module.partition(".")[0]
    return top in BY_VERSION or top in sys.stdlib_module_names - {"__main__"}


def is_users(module: str) -> bool:
    """Whether a module is the user's: neither identified by version nor installed."""
    path = source_file(module)
    return not by_version(module) and (path is None or not set(INSTALLED) & set(path.parts))


def source_file(module: str) -> Path | None:
    """Path of a module's source; None in an interactive session or for compiled modules."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file is not None and Path(file).is_file() else None


@functools.lru_cache(100)
def functions_by_name(source: bytes) -> Counter[str]:
    """Number of functions of each qualified name in a source: two lambdas of one scope have the same."""
    found, left = Counter[str](), list[types.CodeType]()
    with suppress(SyntaxError, ValueError):
        left.append(compile(source, "<source>", "exec", dont_inherit=True))
    while left:
        inner = [each for each in left.pop().co_consts if isinstance(each, types.CodeType)]
        found.update(each.co_qualname for each in inner)
        left += inner
    return found


def _is_neighbour(other: str, module: str, root: Path) -> bool:
    """Whether a module is in the same package as another, or in the same folder tree."""
    path = source_file(other)
    if path is None or other.partition(".")[0] == module.partition(".")[0]:
        return path is not None
    return path.is_relative_to(root) and is_users(other)


@functools.cache
def imports(source: bytes, package: str) -> set[str]:
    """Names that the import statements of a source file may mean, in full."""
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):
        return set()
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            stem = ".".join([*above, *([node.module] if node.module else [])])
            found |= {stem} | {f"{stem}.{alias.name}".lstrip(".") for alias in node.names}
    parents = {".".join(name.split(".")[:count]) for name in found for count in range(1, name.count(".") + 1)}
    return (found | parents) - {""}
