"""An estimator of the user's own, one file outside the package, through the commands; and one line for each mistake."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from estimators import ESTIMATORS, Estimator, FirstOrder, ZerothOrder, find_estimator, make_estimator, register
from estimators.catalogue import CATALOGUE
from mjx_study import cli
from mjx_study.cli import options
from mjx_study.plots.style import STYLE, style_of
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.findings import rows_of
from mjx_study.study.run import load_study

PAGE = (Path(__file__).parents[1] / "docs" / "estimators.md").read_text()
(CODE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
OWN = "my_estimators:SignAgreement"

pytestmark = pytest.mark.usefixtures("shared_programs")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The page's file, in the current directory; the tests' own settings stand."""
    monkeypatch.setattr(options, "configure", lambda **_: None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_estimators.py").write_text(CODE)
    path = list(sys.path)
    yield tmp_path
    assert sys.path == path
    sys.modules.pop("my_estimators", None)


def test_compare_and_sweep_take_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["pusher", "--horizon", "4", "--samples", "8", "--reference-samples", "8", "--stiffness", "10,100"]
    small += ["--chunk-size", "4"]
    common = [*small, "--contact", "penalty", "--estimators", f"fobg,{OWN}"]
    assert cli.main(["compare", *common, "--baseline", "none", "--output", "out"]) == 0
    assert re.search(r"^ +SignAgreement  ", capsys.readouterr().out, re.MULTILINE)
    first, mine, *_ = rows_of(load_study(folder / "out"))
    assert mine.estimator == OWN and first.variance != mine.variance > 0
    assert (folder / "out" / "comparison.pdf").exists()
    assert cli.main(["sweep", *common, "--seeds", "2", "--output", "study"]) == 0
    assert cli.main(["plot", "study"]) == 0 and cli.main(["report", "study"]) == 0
    assert "SignAgreement" in (folder / "study" / "report.html").read_text()


def test_optimise_takes_it_and_goes_on(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["optimise", "pusher", "--reference", "--horizon", "4", "--samples", "8", "--seeds", "1"]
    arguments += ["--estimator", OWN, "--learning-rate", "0.01", "--output", "out", "--json", "--iterations"]
    assert cli.main([*arguments, "2"]) == 0 and cli.main([*arguments, "3"]) == 0
    capsys.readouterr()
    assert {path.name for path in (folder / "out").iterdir()} >= {
        "policy-my_estimators.SignAgreement.json", "descent.png", "results.nc",
    }  # fmt: skip
    sys.modules.pop("my_estimators")
    (folder / "my_estimators.py").write_text(CODE.replace("sign(low.mean) ==", "sign(low.mean) !="))
    assert cli.main([*arguments, "4"]) == 2
    assert "holds another study (" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "unknown|one of zobg, .*, or module:name of your own \\(there is no module 'my_estimators' here or"),
        ("1 +", "importing my_estimators raised SyntaxError"),
        ("def other(): ...", "my_estimators has no 'SignAgreement'; it has other"),
        ("SignAgreement = 3", "SignAgreement is neither an Estimator nor an Estimator class, but of type int"),
        (CODE.replace("combine", "mix"), "SignAgreement has no combine: an Estimator needs them"),
        (CODE.replace('"differentiation"', '"gradients"'), "needs gradients; the oracles are evaluation, pair, "),
        (CODE.replace(': str = "zero_noise"', ": str").replace("baseline", "level"), "needs the option level; set it"),
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
    monkeypatch.setitem(CATALOGUE, "twice", CATALOGUE["fobg"])  # taken out again after the test
    monkeypatch.setitem(ESTIMATORS, "twice", FirstOrder)
    del ESTIMATORS["twice"], CATALOGUE["twice"]

    @register
    class Twice(FirstOrder):
        name, label = "twice", "FoBG, twice"

    assert ESTIMATORS["twice"] is Twice and make_estimator("twice") == Twice() != FirstOrder()
    assert CATALOGUE["twice"].label == "FoBG, twice" and StudyConfig.option("estimators").check(("twice",))
    assert style_of("twice")[0] == "FoBG, twice"
    with pytest.raises(ValueError, match="there is already an estimator 'twice'"):
        register(Twice)
    with pytest.raises(ValueError, match="Nameless has no name and no needs"):
        register(type("Nameless", (Estimator,), {"combine": lambda self: None}))


def test_every_estimator_has_a_style_of_its_own() -> None:
    assert set(STYLE) == set(ESTIMATORS)
    assert len({style_of(name) for name in ESTIMATORS}) == len({style_of(name)[1:] for name in ESTIMATORS}) == 15
    assert style_of(OWN) == style_of(OWN) and style_of(OWN)[0] == "SignAgreement"
    assert style_of(OWN)[1:] not in STYLE.values()
    assert style_of("zobg")[0] == ZerothOrder.label and jax.tree.leaves(ZerothOrder()) == [ZerothOrder()]
