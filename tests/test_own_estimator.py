"""An estimator of the user's own, one file outside the package, through the commands; and one line for each mistake."""

import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

from estimators import ESTIMATORS, Estimator, FirstOrder, ZerothOrder, find_estimator, make_estimator, register
from mjx_study import cli
from mjx_study.options.configuration import OPTIONS
from mjx_study.plots.style import combines, style_of
from mjx_study.storage.folder import load_study
from tests.documents import altered

PAGE = (Path(__file__).parents[1] / "docs" / "estimators.md").read_text()
(CODE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
HEIRS = """

class Cautious(estimators.AlphaOrder):
    name = "cautious"


class Doubled(estimators.FirstOrder):
    label = "Twice FoBG"

    def combine(self, differentiation):
        return estimators.summarise(2 * differentiation.gradient)
"""
"""An interpolation, and one whose mean is wrong, under the name of the class that it inherits from and a label of its
own."""
OWN, CAUTIOUS, DOUBLED = "my_estimators:SignAgreement", "my_estimators:Cautious", "my_estimators:Doubled"
ANALYTIC = ["pusher", "--horizon", "4", "--contact", "reference", "--stiffness", "10,100"]
STUDIES = {
    "batch": ["--samples", "8", "--reference-samples", "8", "--seeds", "1"],
    "gradients": ["--samples", "8,16", "--reference-samples", "8", "--seeds", "3"],
    "descents": ["--iterations", "2", "--samples", "4", "--seeds", "2", "--learning-rate", "0.01"],
    "landscapes": ["--points", "3", "--direction", "0", "--span=-1,1", "--samples", "4"],
}
"""Of each kind, the smallest that has all its figures; test_kinds names them."""
BOTH = {"SignAgreement", "Cautious"}
IN_FIGURES = {"alpha": {"Cautious"}, "map_stiffness_samples": set[str]()}
"""What figures show of them, if not both: a map is of zobg and fobg."""
CHOSEN = ["--estimators", f"zobg,fobg,{OWN},{CAUTIOUS},registered", "--chunk-size", "4"]
NUMBER = {"batch": "variance", "gradients": "variance", "descents": "final_cost", "landscapes": "slope"}

pytestmark = pytest.mark.usefixtures("shared_programs")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The page's file, in the current directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_estimators.py").write_text(CODE + HEIRS)
    path = list(sys.path)
    yield tmp_path
    assert sys.path == path
    sys.modules.pop("my_estimators", None)


class Registered(FirstOrder):
    """Known while a study is computed, and not when it is read."""

    name, label = "registered", "Registered"


@pytest.fixture(scope="module")
def studies(shared_programs: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A study of each kind."""
    root = tmp_path_factory.mktemp("studies")
    (root / "my_estimators.py").write_text(CODE + HEIRS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setitem(ESTIMATORS, "registered", Registered)
        for name, arguments in STUDIES.items():
            assert cli.main(["sweep", *ANALYTIC, *arguments, *CHOSEN, "--output", name]) == 0
    sys.modules.pop("my_estimators", None)
    return {name: root / name for name in STUDIES}


@pytest.mark.parametrize("name", STUDIES)
def test_every_figure_and_report_shows_it(name: str, studies: dict[str, Path], folder: Path) -> None:
    """A report has a row for each contact model."""
    shutil.copytree(studies[name], folder / "out")
    assert cli.main(["plot", "out", "--style", "paper", "--format", "svg"]) == 0
    drawn = {path.stem: path.read_text() for path in (folder / "out").glob("*.svg")}
    assert drawn
    for figure, text in drawn.items():
        assert {own for own in BOTH if own in text} == IN_FIGURES.get(figure, BOTH), figure
    data = load_study(folder / "out")
    assert bool(data[NUMBER[name]].sel(estimator=[OWN, CAUTIOUS]).notnull().all())
    assert cli.main(["report", "out"]) == 0
    page = (folder / "out" / "report.html").read_text()
    assert [page.count(f"<td>{own}</td>") for own in BOTH] == [data.sizes["model"]] * 2 == [2, 2]


def test_a_descent_with_it_goes_on_until_its_code_changes(
    folder: Path, capsys: pytest.CaptureFixture[str], studies: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ESTIMATORS, "registered", Registered)
    shutil.copytree(studies["descents"], folder / "out")
    longer = ["sweep", *ANALYTIC, *STUDIES["descents"], *CHOSEN, "--output", "out", "--iterations"]
    assert cli.main([*longer, "3"]) == 0
    sys.modules.pop("my_estimators")
    (folder / "my_estimators.py").write_text(CODE.replace("sign(low.mean) ==", "sign(low.mean) !=") + HEIRS)
    assert cli.main([*longer, "4"]) == 2
    assert "holds another study (" in capsys.readouterr().err


TRAP = """
from pathlib import Path
Path("trapped").touch()
raise SystemExit(0)
"""


def test_reading_imports_nothing(studies: dict[str, Path], folder: Path) -> None:
    """Not the estimators and tasks that a study names, which are drawn as they would be where they are known."""
    shutil.copytree(studies["batch"], folder / "out")
    (folder / "my_estimators.py").write_text(TRAP)
    document = json.loads((folder / "out" / "study.json").read_text())
    config = document["config"] | {"tasks": ["my_estimators:task"]}
    assert cli.main(["plot", "out"]) == 0 and cli.main(["report", "out"]) == 0
    assert combines(CAUTIOUS, document["described"]) and not combines("registered", document["described"])
    altered(folder / "out" / "study.json", config=config)
    for command in ("plot", "report"):
        assert cli.main([command, "out"]) == 2  # its cells are of another study
    assert not (folder / "trapped").exists() and "my_estimators" not in sys.modules
    page = (folder / "out" / "report.html").read_text()
    assert "<td>Cautious</td>" in page and "<td>Registered</td>" in page


def test_its_slope_along_a_parameter_is_that_of_one_order(studies: dict[str, Path]) -> None:
    slope = load_study(studies["landscapes"])["slope"]
    zeroth, first, mine = (slope.sel(estimator=name).values for name in ("zobg", "fobg", OWN))
    assert np.all(np.isclose(mine, zeroth, rtol=1e-9) | np.isclose(mine, first, rtol=1e-9))


def test_findings_report_its_bias(capsys: pytest.CaptureFixture[str]) -> None:
    """The mean of one is twice the gradient; that of the other is right."""
    arguments = ["--samples", "400", "--reference-samples", "400", "--estimators", f"{DOUBLED},{CAUTIOUS}", "--json"]
    assert cli.main(["compare", *ANALYTIC, *arguments]) == 0
    found = json.loads(capsys.readouterr().out)["findings"]
    (told,) = (sentence for sentence in found if "mean is" in sentence)
    assert told.startswith("reference: Twice FoBG's mean is biased by") and re.search(r"\b10\b.*\b100 N/m", told)
    shares = re.findall(r"([\d.]+) ± ([\d.]+) %", told)
    assert shares
    for share, error in shares:
        assert abs(float(share) - 100) < 3 * float(error) < 60


def test_gradcheck_takes_it(capsys: pytest.CaptureFixture[str]) -> None:
    """Its mean, along a path and along the means; the name is the one that was given."""
    common = ["gradcheck", "tests.carts:walled_cart", "--contact", "penalty", "--stiffness", "10", "--mean"]
    assert cli.main([*common, "--estimators", f"fobg,{DOUBLED}", "--json"]) == 1
    right, wrong = json.loads(capsys.readouterr().out)["checks"]
    assert (right["estimator"], right["verdict"]) == ("fobg", "right")
    assert (wrong["estimator"], wrong["verdict"]) == (DOUBLED, "biased")
    assert abs(wrong["relative_gap"]) == pytest.approx(1.0, abs=0.1)
    assert cli.main([*common, "--estimators", f"{OWN},{DOUBLED}", "--direction", "means"]) == 1
    setting, noise, path, _, *table = capsys.readouterr().out.splitlines()
    assert setting == "tests.carts:walled_cart: 1000 samples at each node of the path, seed 0, float64"
    assert noise.startswith("gaussian noise of sigma = ") and "about theta, direction means" in path
    for label in ("SignAgreement", "Twice FoBG"):
        assert any(re.match(rf" *penalty +10 +{label} ", line) for line in table)


def test_tables_have_its_label(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--horizon", "4", "--samples", "4", "--estimators", f"{OWN},{DOUBLED}"]
    for command in (
        ["compare", "pusher", "--contact", "reference", "--stiffness", "10", "--reference-samples", "8"],
        ["optimise", "pusher", "--reference", "--iterations", "1", "--learning-rate", "0.01"],
    ):
        assert cli.main([*command, *few]) == 0
        table = capsys.readouterr().out
        assert "SignAgreement  " in table and "Twice FoBG  " in table and "Doubled" not in table


def test_examples_of_estimators_with_required_options_are_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["estimators", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)["estimators"]
    needy = [entry for entry in entries if entry["requires"]]
    assert [entry["name"] for entry in needy] == ["fobg_clipped", "fobg_truncated"]
    for entry in needy:
        (program, command, _, *options) = entry["example"].split()
        assert (program, command) == ("mjx-study", "compare")
        assert cli.main([command, *ANALYTIC, *options, "--samples", "8", "--dry-run"]) == 0


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "choose from zobg, .*, or module:name of your own \\(there is no module 'my_estimators' here or"),
        ("SignAgreement = 3", "SignAgreement is neither an Estimator nor an Estimator class, but of type int"),
        (CODE.replace("combine", "mix"), "SignAgreement has no combine: an Estimator needs them"),
        (CODE.replace('"differentiation"', '"gradients"'), "needs gradients; the oracles are evaluation, pair, "),
        (CODE.replace(': str = "zero_noise"', ": str").replace("baseline", "level"), "needs the option `level`; set"),
    ],
)
def test_mistakes_get_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], source: str | None, message: str
) -> None:
    (folder / "my_estimators.py").unlink() if source is None else (folder / "my_estimators.py").write_text(source)
    assert cli.main(["compare", "pusher", "--estimators", OWN]) == 2
    printed = capsys.readouterr()
    assert re.search(message, printed.err) and printed.err.count("\n") == 1 and printed.out == ""


def test_an_object_keeps_its_options_and_a_class_takes_those_that_it_has(folder: Path) -> None:
    (folder / "my_estimators.py").write_text(f'{CODE}\nown = SignAgreement(baseline="none")\n')
    assert make_estimator("my_estimators:own", baseline="leave_one_out").baseline == "none"  # type: ignore[attr-defined]
    made = make_estimator(OWN, baseline="leave_one_out", gamma=3.0)
    assert type(made) is find_estimator(OWN) and made.baseline == "leave_one_out"  # type: ignore[attr-defined]
    assert make_estimator(made) is made


def test_a_registered_one_has_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ESTIMATORS, "twice", FirstOrder)  # removed again after the test
    del ESTIMATORS["twice"]

    @register
    class Twice(FirstOrder):
        name, label = "twice", "FoBG, twice"

    assert ESTIMATORS["twice"] is Twice and make_estimator("twice") == Twice() != FirstOrder()
    assert OPTIONS["estimators"].check(("twice",))
    assert style_of("twice") == ("FoBG, twice", *style_of("fobg")[1:])
    with pytest.raises(ValueError, match="there is already an estimator 'twice'"):
        register(Twice)
    with pytest.raises(ValueError, match="Nameless has no name and no needs"):
        register(type("Nameless", (Estimator,), {"combine": lambda self: None}))


def test_every_estimator_has_its_own_style() -> None:
    styles = [style_of(name) for name in ESTIMATORS]
    assert len({label for label, *_ in styles}) == len({tuple(rest) for _, *rest in styles}) == len(ESTIMATORS)
    assert style_of(OWN) == style_of(OWN) and style_of(OWN)[0] == "SignAgreement"
    assert style_of(OWN)[1:] not in [estimator.style for estimator in ESTIMATORS.values()]
    assert style_of("zobg")[0] == ZerothOrder.label and jax.tree.leaves(ZerothOrder()) == [ZerothOrder()]
