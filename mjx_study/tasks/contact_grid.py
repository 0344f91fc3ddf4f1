"""Contact models of a study: families over stiffnesses, or MuJoCo's parameters, with their warnings."""

import dataclasses
import itertools
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager

import jax.numpy as jnp
import numpy as np

from mjx_study.choices import DEFAULT_SOLIMP, DEFAULT_SOLREF, FAMILIES, REFERENCE, laws_of, takes_stiffness
from mjx_study.limits import MOST_MODELS, check_count
from mjx_study.options.option import OptionError, reject_untaken
from mjx_study.simulation.contact import (
    ContactModel,
    ContactWarning,
    cone_edges,
    contact_model,
    contact_pair,
    family_model,
    stiffness_from_solref,
)
from mjx_study.table import digits_to_tell_apart
from mjx_study.tasks.task import Task


@dataclasses.dataclass(frozen=True)
class ContactPoint:
    """A contact model of a study.

    Attributes:
        family: name of the contact family, "reference", or solref and solimp.
        stiffness: spring stiffness K [N/m]; None without contact or spring.
        contact: the contact model; None for the MJCF's and for the reference.
        digits: significant digits of the stiffness in messages, enough to distinguish the models of a sweep.
    """

    family: str
    stiffness: float | None
    contact: ContactModel | None
    digits: int = 6

    @property
    def analytic(self) -> bool:
        return self.family == REFERENCE

    @property
    def stiffness_or_zero(self) -> float:
        """Stiffness in numbers that are kept and in analytic systems, 0 where there is none [N/m]."""
        return 0.0 if self.stiffness is None else self.stiffness

    @property
    def label(self) -> str:
        return self.family if self.stiffness is None else f"{self.family}, K = {self.stiffness:.{self.digits}g} N/m"


Grid = tuple[tuple[ContactPoint, ...], tuple[str, ...]]
"""Contact models and their warnings."""


def family_grid(
    task: Task,
    families: Sequence[str] | None = None,
    stiffnesses: Sequence[float] | None = None,
    damping: float | None = None,
    smoothing: float | None = None,
) -> Grid:
    """Return the contact models of a sweep, family by family.

    Args:
        task: source of the effective mass and of defaults for arguments that are None.
        stiffnesses: stiffnesses for families that take one [N/m].
        damping: override of each family's damping [N s/m].
        smoothing: override of the smoothing kappa of laws other than MuJoCo's [J].
    """
    points, messages = [], []
    stiffnesses = task.defaults.stiffnesses if stiffnesses is None else stiffnesses
    families = task.defaults.families if families is None else families
    check_count(len(families) * len(stiffnesses), "contact models", MOST_MODELS, "give fewer stiffnesses or families")
    digits = digits_to_tell_apart(stiffnesses)
    for family in families:
        if family == REFERENCE:
            if task.reference is None:
                raise ValueError(f"{task.name} has no analytic reference")
            if task.onset != "none":
                raise OptionError("onset", "has no counterpart in the analytic references: omit it")
            found = stiffnesses if task.contact_pair is not None else (None,)
            points += [ContactPoint(family, stiffness, None, digits) for stiffness in found]
            continue
        swept = family not in FAMILIES or FAMILIES[family].swept
        for stiffness in stiffnesses if swept else (None,):
            with _warnings_of_contact() as caught:
                contact = None if family == "mjcf" else _contact(task, family, stiffness, damping, smoothing)
                points.append(ContactPoint(family, stiffness or _stiffness(task, contact), contact, digits))
            messages += [f"{points[-1].label}: {warning.message}" for warning in caught]
    return tuple(points), tuple(messages)


def single_contact(
    task: Task,
    family: str | None = None,
    stiffness: float | None = None,
    damping: float | None = None,
    smoothing: float | None = None,
) -> tuple[ContactPoint, tuple[str, ...]]:
    """Return the contact model of a single run, and its warnings: by default the task's main family at its middle
    stiffness. OptionError for a stiffness or damping that the family does not take."""
    families, stiffnesses = single_defaults(
        task, None if family is None else (family,), None if stiffness is None else (stiffness,)
    )
    reject_untaken(families, stiffness=stiffness, damping=damping, smoothing=smoothing)
    (point,), messages = family_grid(task, families, stiffnesses, damping, smoothing)
    return point, messages


def single_defaults(
    task: Task, families: Sequence[str] | None = None, stiffnesses: Sequence[float] | None = None
) -> tuple[tuple[str, ...], tuple[float, ...] | None]:
    """Contact families and stiffnesses [N/m] of a single run: the task's main family at its middle stiffness in place
    of None; no stiffness for families without one."""
    families = (task.defaults.main_family,) if families is None else tuple(families)
    if stiffnesses is None and takes_stiffness(families):
        stiffnesses = (task.defaults.middle_stiffness,)
    return families, None if stiffnesses is None else tuple(stiffnesses)


def backward_grid(
    task: Task,
    points: Sequence[ContactPoint],
    families: Sequence[str],
    stiffness: float | None = None,
    margin: float | None = None,
) -> Grid:
    """Return contact models with surrogate derivatives, and the warnings of the surrogate models.

    Args:
        points: contact models to roll out; analytic systems are kept unchanged.
        families: families that supply derivatives, each for every model at its stiffness; "none" for exact ones.
        stiffness: stiffness of the families that take one, instead of the model's [N/m].
        margin: distance at which contact begins in the surrogates [m]; None for the MJCF's.

    Raises:
        ValueError: a family lacks a stiffness, or a contact model is the MJCF's.
    """
    found, messages = [point for point in points if point.analytic or "none" in families], []
    simulated = [point for point in points if not point.analytic]
    for family, point in itertools.product((name for name in families if name != "none"), simulated):
        if point.contact is None:
            raise OptionError("backward", f"has no effect on contact {point.family}: choose another family")
        own = (stiffness or point.stiffness) if FAMILIES[family].swept else None
        with _warnings_of_contact() as caught:
            other = _contact(task, family, own, None)
        name = f"{point.family}, backward {family}"
        if stiffness is not None and own:
            name += f" {stiffness:g} N/m"
        if margin is not None:
            other = dataclasses.replace(other, margin=jnp.asarray(margin, other.solref.dtype))
            name += f" from {margin:g} m"
        contact = dataclasses.replace(point.contact, backward=other)
        found.append(dataclasses.replace(point, family=name, contact=contact))
        messages += [f"{found[-1].label}: {warning.message}" for warning in caught]
    return tuple(found), tuple(messages)


def solver_grid(task: Task, solrefs: Sequence[Sequence[float]], solimps: Sequence[Sequence[float]]) -> Grid:
    """Return contact models in MuJoCo's terms, every solref with every solimp.

    Empty sequences stand for MuJoCo's defaults. A value that MuJoCo would silently alter is a ValueError.
    """
    points, messages = [], []
    digits = digits_to_tell_apart(itertools.chain(*solrefs, *solimps))
    count = max(1, len(solrefs)) * max(1, len(solimps))
    check_count(count, "contact models", MOST_MODELS, "give fewer solrefs or solimps")
    for solref, solimp in itertools.product(solrefs or (DEFAULT_SOLREF,), solimps or (DEFAULT_SOLIMP,)):
        if len(solref) != 2 or len(solimp) != 5:
            raise ValueError(f"solref takes 2 numbers and solimp 5, got {len(solref)} and {len(solimp)}")
        parts = {"solref": solref} | ({"solimp": solimp} if solimps else {})
        name = " ".join(f"{key} {' '.join(f'{value:.{digits}g}' for value in part)}" for key, part in parts.items())
        with _warnings_of_contact() as caught:
            contact = contact_model(solref, solimp, scene=task.scene)
            points.append(ContactPoint(name, _stiffness(task, contact), contact, digits))
        messages += [f"{name}: {warning.message}" for warning in caught]
    return tuple(points), tuple(messages)


@contextmanager
def _warnings_of_contact() -> Generator[list[warnings.WarningMessage]]:
    """Collect the warnings of contact models built in this context; numbers that overflow are a ValueError."""
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", ContactWarning)
            yield caught
    except ArithmeticError as error:
        raise ValueError(f"a contact model's numbers are too large or too small: {error}") from error


def _contact(
    task: Task, family: str, stiffness: float | None, damping: float | None, smoothing: float | None = None
) -> ContactModel:
    """Build a family's contact model with a damping [N s/m]; by default the task's, if the family has none."""
    law = bool(laws_of([family]))
    if law and task.onset != "none":
        raise OptionError("onset", f"is for MuJoCo's law, and {family} is another: omit it")
    if damping is None and family in FAMILIES and FAMILIES[family].dampratio == 0 and not law:
        damping = task.defaults.damping
    damping = None if stiffness is None else damping
    mass = 1.0 if stiffness is None else task.effective_mass
    edges = cone_edges(task.scene, *task.contact_pair) if law and task.contact_pair else 1
    given = {"stiffness": stiffness, "damping": damping, "smoothing": smoothing if law else None}
    return family_model(family, task.scene, **given, effective_mass=mass, edges=edges)


def _stiffness(task: Task, contact: ContactModel | None) -> float | None:
    """Spring stiffness K [N/m] of a contact model not defined by one; None without contact or spring."""
    if task.contact_pair is None:
        return None
    if contact is not None and contact.law is not None:
        return None
    if contact is None:
        solref = contact_pair(task.scene, *task.contact_pair).solref
    else:
        solref = np.asarray(contact.solref)
    return stiffness_from_solref(solref.tolist(), effective_mass=task.effective_mass)[0] or None
