"""Cautions about the numbers of a diagnosis, and advice drawn from them."""

import math
from collections.abc import Iterator
from typing import Final

from mjx_study.diagnose.measurement import SAMPLES, TARGET_ERROR
from mjx_study.diagnose.run import Diagnosis, enough, one_digit, round_up
from mjx_study.results.findings import ERROR_PER_STRENGTH, LEAST_SPREAD, MOST_STRENGTH, NOTABLE_SHARE, linear_error
from mjx_study.table import number, percent

MIN_SAMPLES: Final = 100  # number of samples below which the page warns
LEAST_EFFECT: Final = 1e-6  # change of the cost over sigma, relative to the cost, below which the page warns
SMOOTH_SHARE: Final = 0.01
"""Share of the approach speed lost in the first step below which force counts as setting in without a jump."""
WIDTH_RATIO: Final = 3.0  # recommended width of the impedance's rise, as a multiple of a step's travel

Advice = tuple[str, str]
"""A recommendation, and options of `compare` that demonstrate it."""


def cautions(found: Diagnosis) -> Iterator[str]:
    """Caveats about the numbers on the page."""
    if found.lost:
        remedy = "see below" if found.derivatives.failure == "nan" else "try a smaller --timestep or --sigma"
        yield f"{found.lost} samples are not finite and were left out: {remedy}"
    if found.unconverged:
        yield (
            f"in {found.unconverged} rollouts the contact solver did not converge: their derivatives are not those "
            "of the simulated step; raise --solver-iterations and --solver-ls-iterations"
        )
    if unstable := [each for each in found.touches if not each.stable]:
        yield (
            f"the step in contact is unstable: {unstable[0].pair}, h^2 k = {unstable[0].stiffness:.2g}; take a "
            "smaller --timestep or a softer contact"
        )
    if 0 < (effect := found.norm * found.setting.sigma) < LEAST_EFFECT * found.cost:
        yield (
            f"the cost hardly depends on theta: within sigma it changes by {number(effect, 1)}, and is "
            f"{number(found.cost, 1)}; take another cost, or controls in units in which they matter"
        )
    if found.samples < MIN_SAMPLES:
        yield f"{found.samples} samples are few: --samples {SAMPLES} takes longer and resolves more"
    if found.best.verdict == "undecided" and found.resolved:
        yield f"{found.samples} samples do not decide if the mean of {found.best.estimator} is right: {_more(found)}"
    if not found.derivatives.passed:
        yield "derivatives are not right (see below): do not trust a first-order estimate"


def advise(found: Diagnosis) -> Iterator[Advice]:
    """Recommendations: the best estimator, the bias of first order, and whether its correction can be trusted."""
    if not found.resolved:
        yield _unresolved(found), ""
        return
    yield _best(found)
    if not found.onsets.get("onsets"):
        yield (
            "no contact begins, so the result says nothing about contact: take a longer --horizon, a larger --sigma or "
            "another start (for a file, its first keyframe)",
            "",
        )
        return
    by_name = {each.estimator: each for each in found.estimators}
    if by_name["fobg"].verdict == "biased":
        yield _bias(found)
    elif not found.best.estimator.endswith("_onset"):
        return  # the onset term is not recommended
    if not found.law:
        yield from _onset(found)


def _more(found: Diagnosis) -> str:
    """How the verdict on the best estimator's mean can be had."""
    factor = found.best.more_samples()
    if math.isinf(factor):
        return "the mean cost bends too much along a path; take a shorter one (gradcheck --mean --span)"
    return f"about {enough(found, factor)} would"


def _unresolved(found: Diagnosis) -> str:
    """What can be done where the gradient is not distinguishable from 0."""
    sound = [each for each in found.estimators if each.verdict in ("unbiased", "right") and each.variance < math.inf]
    if not found.norm or not sound:
        why = "no estimator without visible bias has a finite variance" if found.norm else "the gradient is 0"
        return f"no estimator can be recommended: {why}; take another start or cost, in a task of your own"
    best = min(sound, key=lambda each: each.error(1.0))
    whole, tenth = (round_up(best.variance / (share * found.norm) ** 2) for share in (1.0, TARGET_ERROR))
    why = "it is unbiased, whatever the contact" if best.verdict == "unbiased" else "its mean is right"
    biased = [each.estimator for each in found.estimators if each.verdict == "biased"]
    others = f"the means of {', '.join(biased)} are off, by an unknown share" if biased else "the others are undecided"
    return (
        f"at {found.setting.level}, take {best.estimator}: {why}. If the gradient's norm is {number(found.norm, 2)}, a "
        f"relative error of 100 % needs {whole} samples and one of {percent(TARGET_ERROR)} {tenth}; a descent may need "
        "fewer in an iteration, since errors of its iterations average out (mjx-study optimise). Whether another "
        f"estimator is better is open, as the gradient is not significantly different from 0: {others}"
    )


def _best(found: Diagnosis) -> Advice:
    best, bias, needed = found.best, found.off_text(found.best), ""
    if math.isfinite(found.samples_needed):
        many = round_up(found.samples_needed)
        needed = f"; a relative error of {percent(TARGET_ERROR)} needs {many} sample{'' if many == '1' else 's'}"
    if best.verdict == "undecided":
        needed += f"; whether its mean is right is undecided: {bias} off along the paths"
    elif not needed:
        needed = f"; its bias of {bias} remains, however many samples"
    elif best.verdict == "biased":
        needed += f"; its bias of {bias} remains"
    return f"at {found.setting.level}, take {best.estimator}{needed}", ""


def _bias(found: Diagnosis) -> Advice:
    by_name, timestep = {each.estimator: each for each in found.estimators}, found.task.scene.timestep
    text = f"plain first order is biased by {found.off_text(by_name['fobg'])}, "
    corrected = not found.law and by_name["fobg_onset"].verdict == "right"
    contacts = max((each.jump for each in found.touches), default=0.0)
    if found.law or max(contacts, found.onsets["onset_strength"]) <= SMOOTH_SHARE:
        text += "though force sets in without a jump: something else jumps, as where corners and edges touch, "
        text += "and only zobg is sure to be unbiased"
    else:
        limit = "a joint's or tendon's limit" if found.touches else "contact or a limit"
        what = "contact" if contacts > SMOOTH_SHARE else limit
        cause = f"because {what} sets in with a jump: the onset term corrects that"
        text += cause if corrected else f"and {what} sets in with a jump, the usual cause"
        if what == limit:
            text += '; an impedance that rises from 0 has no jump: solimplimit="0 0.95 0.1" in the MJCF'
    if travel := max((each.speed * timestep for each in found.touches if each.jump > SMOOTH_SHARE), default=0.0):
        rising = f'solimp="0 0.95 {WIDTH_RATIO * travel:.1g}"'
        text += f"; an impedance that rises from 0 has no jump: {rising} in the MJCF"
    return text, "--onset linear" if corrected else ""


def _onset(found: Diagnosis) -> Iterator[Advice]:
    """Whether the onset term can be trusted, unless its mean was measured to be right."""
    by_name, timestep = {each.estimator: each for each in found.estimators}, found.task.scene.timestep
    plain, corrected = by_name["fobg"], by_name["fobg_onset"]
    spread, strength = found.onsets["onset_spread"], found.onsets["onset_strength"]
    linear, left_out = ERROR_PER_STRENGTH * strength, found.onsets["onsets_missed"] / found.onsets["onsets"]
    if corrected.verdict != "right" and left_out > NOTABLE_SHARE:
        yield (
            f"{percent(left_out)} of the contacts have no onset term, since they chatter or are too many, and keep "
            "their bias: a shorter --horizon, more damping of the contact or a smaller --timestep has fewer of them",
            "",
        )
    if corrected.verdict == "right":
        if spread < LEAST_SPREAD:
            yield (
                f"the noise is narrow for onset terms (the first contact varies by {spread:.2g} steps; "
                f"{LEAST_SPREAD:g} usually suffice), but fobg_onset is right here, by the check of the mean",
                "",
            )
    elif spread < LEAST_SPREAD:
        remedy = "a larger --sigma, or noise on the start"
        if spread > 0:
            share, sigma = spread / LEAST_SPREAD, found.setting.sigma
            remedy = f"--timestep {one_digit(timestep * share)} or --sigma {one_digit(sigma / share, math.ceil)}"
        yield f"for fobg_onset and aobg_onset the noise is too narrow: take {remedy}", ""
    elif (
        corrected.verdict == "biased"
        and corrected.bias > linear * (plain.bias + corrected.bias)
        and (strength <= MOST_STRENGTH)
    ):
        yield (
            f"the onset term leaves a bias of {found.off_text(corrected)}, which its own error does not "
            "explain; the usual causes are corners, edges, grazing and rolling contact; only zobg is surely unbiased",
            "",
        )
    elif linear > NOTABLE_SHARE:
        step = one_digit(timestep * NOTABLE_SHARE / linear)
        yield (
            f"{linear_error(strength)}: --timestep {step} brings that down to {percent(NOTABLE_SHARE)}; the "
            "error of --onset shift does not depend on it",
            "--onset shift",
        )
