"""Imports only point down the layers and never in a circle, and importing has no effect on the process."""

import ast
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.processes import ROOT, run_script

# From the bottom up; a package or module may import from its own layer and from those above it in this list.
LAYERS = [
    "estimators",
    *(
        f"mjx_study.{name}"
        for name in """
            choices _matplotlib version disk caches runtime watchdog table progress limits reference graph simulation
            identification options tasks authoring sources digest identity compiled objective gradcheck results plots
            experiment storage execution diagnose bench render claims report cli __main__ _public
        """.split()
    ),
    "mjx_study",  # the package itself re-exports, so that nothing may import from it
]
PACKAGES = ("estimators", "mjx_study")
# The analytic systems are NumPy alone, and import nothing of the simulator.
REFERENCE_MAY_IMPORT = ("estimators", "mjx_study.reference")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).glob("**/*.py"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_of(module: str) -> int:
    """Index of the layer; an error for a module of ours that is in none."""
    for index, name in enumerate(LAYERS):
        if module == name or (name != "mjx_study" and module.startswith(name + ".")):
            return index
    raise LookupError(f"{module} is in no layer: add it to LAYERS where it belongs")


def imports_of(source: str, module: str, *, is_package: bool) -> set[str]:
    """Modules of ours that a source imports, wherever the import statement stands."""
    parts = module.split(".")
    package = parts if is_package else parts[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            submodules = {f"{stem}.{alias.name}" for alias in node.names if is_module(f"{stem}.{alias.name}")}
            found |= submodules or {stem}
            if submodules and len(submodules) < len(node.names):
                found.add(stem)
    return {name for name in found if name.split(".")[0] in PACKAGES}


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def read(path: Path) -> set[str]:
    return imports_of(path.read_text(), module_of(path), is_package=path.name == "__init__.py")


def refused(module: str, imported: set[str]) -> set[str]:
    """Which of a module's imports are not allowed."""
    here = layer_of(module)
    wrong = {name for name in imported if layer_of(name) > here}
    if module.startswith("mjx_study.reference.") or module == "mjx_study.reference":
        wrong |= {n for n in imported if not any(n == p or n.startswith(p + ".") for p in REFERENCE_MAY_IMPORT)}
    return wrong


def test_imports_point_down() -> None:
    """A module that imports from a later layer is named, with what it imports."""
    wrong = {module_of(path): refused(module_of(path), read(path)) for path in FILES}
    assert {module: names for module, names in wrong.items() if names} == {}


def cycle(imports: Mapping[str, set[str]]) -> list[str]:
    """Modules each of which imports the next, and the last the first; empty if there are none."""
    done: set[str] = set()

    def follow(module: str, path: list[str]) -> list[str]:
        if module in path:
            return path[path.index(module) :]
        if module in done:
            return []
        found = next(filter(None, (follow(each, [*path, module]) for each in sorted(imports.get(module, ())))), [])
        done.add(module)
        return found

    return next(filter(None, (follow(module, []) for module in sorted(imports))), [])


def test_no_files_import_each_other() -> None:
    """Not within functions either."""
    assert cycle({module_of(path): read(path) for path in FILES}) == []


def test_a_cycle_is_found() -> None:
    sources = {
        "mjx_study.cli.plot": "import mjx_study.cli.sweep",
        "mjx_study.cli.sweep": "def run():\n    from mjx_study.cli.studies import run_sweep",
        "mjx_study.cli.studies": "from mjx_study.cli import sweep",
    }
    imports = {module: imports_of(source, module, is_package=False) for module, source in sources.items()}
    assert cycle(imports) == ["mjx_study.cli.sweep", "mjx_study.cli.studies"]
    assert cycle(imports | {"mjx_study.cli.studies": set()}) == []
    assert cycle({"a": {"a"}}) == ["a"]


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("estimators.batches", "import mjx_study.reference.system", {"mjx_study.reference.system"}),
        ("mjx_study.tasks.task", "def f():\n    from mjx_study.objective import Simulator", {"mjx_study.objective"}),
        ("mjx_study.tasks.task", "from .. import objective", {"mjx_study.objective"}),
        ("mjx_study.simulation.contact", "from mjx_study import ContactModel", {"mjx_study"}),
        ("mjx_study.reference.system", "from mjx_study.limits import check_count", {"mjx_study.limits"}),
        ("mjx_study.simulation.contact", "from mjx_study.simulation.dynamics import step\nimport jax", set()),
    ],
)
def test_the_walk_sees(module: str, source: str, wrong: set[str]) -> None:
    assert refused(module, imports_of(source, module, is_package=False)) == wrong


def test_a_missing_layer_is_found() -> None:
    with pytest.raises(LookupError, match="mjx_study.surprise is in no layer"):
        layer_of("mjx_study.surprise")


def test_the_library_needs_nothing_from_outside_the_wheel() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert settings["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == [*reversed(PACKAGES)]
    outside = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {*PACKAGES} | {"tools", "docs"}
    statement = re.compile(rf"^ *(?:from|import) (?:{'|'.join(outside)})\b", re.MULTILINE)
    assert statement.search("def f():\n    from tests.carts import cart")
    assert not [path for path in FILES if statement.search(path.read_text())]


IMPORT_ALL = """
import os, sys, warnings
import jax
before = dict(jax.config.values)
environment, filters = dict(os.environ), list(warnings.filters)
for name in sys.argv[1:]:
    __import__(name)
changed = {key: (old, jax.config.values[key]) for key, old in before.items() if jax.config.values[key] != old}
assert not changed, f"JAX configuration changed: {changed}"
added = {key for key in os.environ if os.environ[key] != environment.get(key)}
assert not added, f"environment changed: {added}"
assert not jax._src.xla_bridge.backends_are_initialized(), "a backend was started"
"""


def test_import_has_no_global_effect() -> None:
    """In a fresh process: no change of JAX's configuration or of the environment, nothing printed."""
    modules = [module_of(path) for path in FILES if path.name != "__main__.py"]
    assert run_script(IMPORT_ALL, *modules).stdout == ""


ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()


def test_the_page_names_packages_and_modules_in_the_order_of_the_layers() -> None:
    """Packages in the table; modules of a single file in the paragraph below it."""
    table, beside = ARCHITECTURE.partition("## Three options")[0].split("Modules of a single file", 1)
    names = [each.removeprefix("mjx_study.") for each in LAYERS if each != "mjx_study" and "._" not in each]
    packages = [name for name in names if (ROOT / name).is_dir() or (ROOT / "mjx_study" / name).is_dir()]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == packages
    assert set(re.findall(r"`(\w+)`", beside)) == set(names) - set(packages)
