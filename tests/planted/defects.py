"""Defects that somebody could write, each a replacement in one file."""

import dataclasses
from pathlib import Path
from typing import Final


@dataclasses.dataclass(frozen=True)
class Defect:
    """A fault, and who may find it.

    Attributes:
        name: of the fault.
        file: where, from the root of the repository.
        old, new: the text that occurs once there, and what replaces it.
        why: how somebody could come to write it.
        tests: files of the fast tests, or single tests of them, that are likely to see it.
        model: of `tests.planted.models`, where gradcheck could see it; None where it has no part in the physics.
    """

    name: str
    file: str
    old: str
    new: str
    why: str
    tests: tuple[str, ...]
    model: str | None = None


def plant(defect: Defect, tree: Path) -> None:
    """Replace the text in a copy of the repository.

    Raises:
        ValueError: the old text does not occur exactly once, or the new one is the same.
    """
    path = tree / defect.file
    text = path.read_text()
    if text.count(defect.old) != 1:
        raise ValueError(f"{defect.name}: {defect.file} has the text {text.count(defect.old)} times: {defect.old!r}")
    if defect.old == defect.new:
        raise ValueError(f"{defect.name} changes nothing")
    path.write_text(text.replace(defect.old, defect.new))


STEP = "tests/test_dynamics.py"
GRAPHS = "tests/test_graph_derivatives.py"
VALUES, SLOPES = "test_the_step_is_mjxs", "test_reverse_mode_is_the_central_difference"
LAWS = "tests/test_constraint.py::test_forces_and_imbalance_are_those_of_mjx"
IMPEDANCE = "tests/test_patches.py::test_stiffness_damping_and_impedance_are_the_c_engines"
CONE = "tests/test_constraint.py::test_the_elliptic_law_is_the_gradient_of_a_convex_cost"
UNBIASED, VARIANCES = "tests/estimators/test_unbiasedness.py", "tests/estimators/test_variances.py"
TERM, FORMULA = "tests/test_onset_term.py", "test_every_sample_is_that_of_the_formula"
STEPWISE, CHOICE = "tests/estimators/test_stepwise.py", "tests/estimators/test_interpolation.py"

# Of each: name, file; the old text; the new one; how somebody comes to write it, which tests see it, and the model.
# fmt: off
DEFECTS: Final[tuple[Defect, ...]] = (
    Defect("constants-by-shape", "mjx_study/graph/scalars.py",
           "return array.shape, array.dtype.str, array.tobytes()",
           "return array.shape, array.dtype.str",
           "a graph with the constants of one model serves another of the same shapes",
           ("tests/test_graph.py::test_a_function_is_written_out_once_for_arguments_of_equal_content",)),
    Defect("frame-without-derivative", "mjx_study/simulation/dynamics.py",
           "        return mjx.fwd_position(model, data)\n",
           """        data = mjx.fwd_position(model, data)
        frame = jax.lax.stop_gradient(data._impl.contact.frame)
        return data.tree_replace({"_impl.contact.frame": frame})
""",
           "the contact frame taken for a constant, as it is on a plane",
           (f"{STEP}::{SLOPES}[sphere-sphere condim 6 elliptic implicitfast]",), "dome"),
    Defect("reference-at-rest", "mjx_study/simulation/dynamics.py",
           "        data = mjx.make_constraint(model, data)  # again: aref depends on qvel\n", "",
           "an apparently repeated call removed", (f"{STEP}::{VALUES}[sphere-sphere condim 1]",), "slider"),
    Defect("implicit-part-dropped", "mjx_study/graph/linear_map.py",
           "return pull(graph, [gap, *results], inputs, [of_gap, *adjoints[:-1]])",
           "return pull(graph, results, inputs, adjoints[:-1])",
           "the step differentiated at a fixed acceleration",
           (f"{STEP}::{SLOPES}[sphere-sphere condim 1]", f"{GRAPHS}::test_the_implicit_derivative_is_that_of_the_loop"),
           "slider"),
    Defect("columns-swapped", "mjx_study/simulation/dynamics.py",
           "return step_change(scene, whole(traced), tuple(point), qacc, moved)",
           "return step_change(scene, whole(traced), tuple(point), qacc, (*moved[:3], moved[3][::-1]))",
           "controls in another order than the actuators",
           (f"{STEP}::test_activation_and_control_each_have_their_column",), "mechanism"),
    Defect("quotient-without-its-denominator", "mjx_study/graph/differentiation.py",
           "slope = scalar(lax.neg_p, scalar(lax.mul_p, node, inverse)) if place else inverse",
           "slope = scalar(lax.neg_p, node) if place else inverse",
           "the quotient rule from memory", (f"{GRAPHS}::test_operations_have_jaxs_derivative[div]",), "slider"),
    Defect("ties-to-one-side", "mjx_study/graph/differentiation.py",
           "ties, strict, dtype.type(0.5)", "ties, strict, dtype.type(1)",
           "both arguments of a maximum count in full where they are equal",
           (f"{GRAPHS}::test_operations_have_jaxs_derivative[max]",)),
    Defect("case-not-taken", "mjx_study/graph/differentiation.py",
           "return which, bool(case)", "return which, not case",
           "the cases of a selection in the order of `where`, which is the other one",
           (f"{GRAPHS}::test_what_a_selection_leaves_out_does_not_count_in_reverse_mode",), "slider"),
    Defect("none-of-several", "mjx_study/graph/differentiation.py",
           "(*shared, (some, True)) if isinstance(some, Node) else shared", "shared",
           "a sum of cases counts where none of them is taken, and 0 times an infinite derivative is NaN",
           (f"{GRAPHS}::test_what_a_selection_leaves_out_does_not_count_in_reverse_mode",)),
    Defect("loop-from-a-constant", "mjx_study/graph/differentiation.py",
           "dtype.type(at == start)", "dtype.type(0)",
           "the derivative of a loop over what it starts from forgotten; what its passes read still counts",
           (f"{GRAPHS}::test_loops_of_known_length_are_functions_at_every_order",)),
    Defect("kept-until-its-last-line", "mjx_study/graph/parts.py",
           "last[at] = max(last[at], end)", "pass",
           "a place in memory is used again within a loop whose next pass still needs it",
           ("tests/test_native.py::test_long_functions_are_divided",)),
    Defect("shares-not-awaited", "mjx_study/graph/handler.c",
           "  while (__atomic_load_n(&all->done, __ATOMIC_ACQUIRE) < all->count) sched_yield();\n", "",
           "a batch is handed on while other threads still compute their shares of it",
           ("tests/test_native.py::test_threads_share_large_batches",)),
    Defect("one-thread-for-all", "mjx_study/runtime.py",
           "str(THREADS * max(2, cores))", '"1"',
           "against a deadlock XLA's pool gets a single thread, for which all programs wait",
           ("tests/test_standstill.py::test_programs_of_several_threads_run_side_by_side",)),
    Defect("samples-share-memory", "mjx_study/graph/kernel.cu",
           "first % 32 * 8", "first % 16 * 8",
           "two samples of a warp keep their values in one place",
           ("tests/test_native.py::test_kernels_compute_what_their_graph_does",)),
    Defect("minus-zero-of-sums", "mjx_study/graph/nodes.py",
           'or (name == "mul" and arguments[0] is arguments[1])', 'or name == "mul"',
           "products are taken for squares, and a sum of them is -0 where JAX has 0",
           ("tests/test_graph.py::test_a_sum_of_zeros_is_not_negative",)),
    Defect("onset-weights-swapped", "mjx_study/simulation/saltation.py",
           "Terms(last * jump / cell, earlier * jump / cell", "Terms(earlier * jump / cell, last * jump / cell",
           "which of both neighbours is nearer", (f"{TERM}::{FORMULA}[jacrev]",)),
    Defect("onset-speed-of-the-step-after", "mjx_study/simulation/saltation.py",
           "moved - timestep * state.qvel) + earlier", "moved) + earlier",
           "the second jump along the position at step k, not at k - 1", (f"{TERM}::{FORMULA}[jacrev]",)),
    Defect("shift-all-ahead", "mjx_study/simulation/shift.py",
           "weight * near.ahead * shift / 2, weight * earlier / 2", "weight * near.ahead * shift, 0 * earlier",
           "one-sided differences, whose error is of first order", (f"{TERM}::{FORMULA}[jacrev]",)),
    Defect("shift-at-the-end-of-the-step", "mjx_study/simulation/shift.py",
           "over_velocity = (1 - cells.since)[:, None]", "over_velocity = cells.since[:, None]",
           "the share of a step since the touch for that before it", (f"{TERM}::{FORMULA}[jacrev]",)),
    Defect("events-of-a-step-in-full", "mjx_study/simulation/shift.py",
           "1 / (jnp.maximum(number, 1) * width)", "1 / width",
           "several events of a step each shift the whole rollout",
           ("tests/test_onset_together.py::test_four_corners_have_the_derivatives_of_one_contact",)),
    Defect("ties-begin-together", "mjx_study/simulation/touch.py",
           "(self.since == own) & (index < guard)", "(self.since == own)",
           "each of several contacts that begin at once finds the others there already",
           ("tests/test_onset_together.py::test_jumps_of_a_step_add_up_whatever_their_order",
            "tests/test_onset_together.py::test_four_corners_have_the_derivatives_of_one_contact")),
    Defect("always-euler", "mjx_study/simulation/dynamics.py",
           "mjx.implicit(model, data) if implicit else mjx.euler(model, data)",
           "mjx.euler(model, data)",
           "one integrator forgotten", (f"{STEP}::test_a_velocity_servo_is_implicit_under_implicitfast",), "dome"),
    Defect("force-left-out-of-damping", "mjx_study/simulation/dynamics.py",
           "data.replace(qacc=qacc, qfrc_constraint=constraint.constraint_force(model, data, qacc))",
           "data.replace(qacc=qacc)",
           "Euler's implicit damping solves again, with the constraint force, which is easily forgotten",
           (f"{STEP}::{VALUES}[mechanism]",), "mechanism"),
    Defect("runge-kutta-weights", "mjx_study/simulation/dynamics.py",
           "(a + 2 * b + 2 * c + d) / 6", "(a + 3 * b + 3 * c + d) / 8",
           "the weights of the other rule of order four", (f"{STEP}::test_runge_kutta_is_mjxs",), "swing"),
    Defect("runge-kutta-stage", "mjx_study/simulation/dynamics.py",
           "third = slopes(*moved(0.5, second))", "third = slopes(*moved(0.5, first))",
           "a stage started from the wrong slope", (f"{STEP}::test_runge_kutta_is_mjxs",), "swing"),
    Defect("elliptic-sliding-direction", "mjx_study/simulation/constraint.py",
           "friction * tangent / safe_length[:, None]",
           "friction * jax.lax.stop_gradient(tangent / safe_length[:, None])",
           "the direction of sliding held fixed; only a slide that turns shows it", (CONE,), "slider"),
    Defect("elliptic-friction-scale", "mjx_study/simulation/constraint.py",
           "friction * tangent / safe_length[:, None]", "tangent / safe_length[:, None]",
           "the cone's scaling of its axes applied once in place of twice", (CONE,), "slider"),
    Defect("impratio-forgotten", "mjx_study/simulation/constraint.py",
           "mu = friction[:, 0] / jnp.sqrt(model.opt.impratio)", "mu = friction[:, 0]",
           "right at the default impratio of 1", (f"{LAWS}[elliptic-condim-3,-4,-6]",), "slider"),
    Defect("friction-loss-one-sided", "mjx_study/simulation/constraint.py",
           "jnp.clip(linear, -loss, loss)", "jnp.clip(linear, 0.0, loss)",
           "friction taken for a unilateral force", (f"{LAWS}[mechanism]",), "mechanism"),
    Defect("equality-only-pushes", "mjx_study/simulation/constraint.py",
           "kind[: rows.ne] = 2", "kind[: rows.ne] = 0",
           "an equality taken for a contact", (f"{LAWS}[mechanism]",), "mechanism"),
    Defect("cholesky-off-by-one", "mjx_study/simulation/linear_algebra.py",
           "sum(upper[k][j] ** 2 for k in range(j))", "sum(upper[k][j] ** 2 for k in range(1, j))",
           "an index from 1", ("tests/test_constraint.py::test_solve_positive_definite",), "slider"),
    Defect("stiffness-over-d-width", "mjx_study/simulation/patches.py",
           "1 / product**2) / high**2", "1 / product**2) / high",
           "k divided by d_width in place of its square", (IMPEDANCE,), "slider"),
    Defect("impedance-above-midpoint", "mjx_study/simulation/patches.py",
           "** power / (1 - midpoint) ** (power - 1)", "** power / midpoint ** (power - 1)",
           "right at the default midpoint of 0.5", (IMPEDANCE,), "slider"),
    Defect("impedance-of-one-sign", "mjx_study/simulation/patches.py",
           "depth = jnp.abs(position) / width", "depth = -position / width",
           "right for contacts, wrong for equalities, which err to both sides", (IMPEDANCE,), "mechanism"),
    Defect("refsafe-at-one-timestep", "mjx_study/simulation/patches.py",
           "jnp.maximum(timeconst, 2 * model.opt.timestep)",
           "jnp.maximum(timeconst, model.opt.timestep)",
           "a factor of two forgotten", (IMPEDANCE,)),
    Defect("rotation-difference-reversed", "mjx_study/simulation/patches.py",
           "return rotation_between(start, end)", "return rotation_between(end, start)",
           "arguments in the order of MJX's own function",
           ("tests/test_patches.py::test_a_rotation_has_its_derivative_at_no_angle",), "ball"),
    Defect("tendon-spring-sign", "mjx_study/simulation/patches.py",
           "(stiffness * (shortest - data.ten_length))",
           "(stiffness * (data.ten_length - shortest))",
           "no effect on any value", ("tests/test_patches.py::test_tendon_springs_are_linear_at_rest",), "tendon"),
    Defect("sine-series-coefficient", "mjx_study/simulation/integration.py",
           "0.5 - square / 48 +", "0.5 - square / 24 +",
           "a wrong coefficient of a series, used below 0.01 rad",
           ("tests/test_integration.py::test_values_are_scipys_and_mjxs",), "ball"),
    Defect("rotation-in-the-world-frame", "mjx_study/simulation/integration.py",
           "w * a + x * cosine + y * c - z * b", "w * a + x * cosine - y * c + z * b",
           "one entry of the product in the other order",
           ("tests/test_integration.py::test_values_are_scipys_and_mjxs",), "ball"),
    Defect("long-way-round", "mjx_study/simulation/integration.py",
           "jnp.where(real < 0, -real, real), jnp.where(real < 0, -axis, axis)",
           "jnp.where(real < 0, -real, real), axis",
           "q and -q are one orientation, and both parts change sign",
           ("tests/test_patches.py::test_both_quaternions_of_an_orientation_are_one",), "ball"),
    Defect("edges-of-the-pyramid", "mjx_study/simulation/contact.py",
           "return 2 * (pair.condim - 1) * float(host.opt.impratio)",
           "return (pair.condim - 1) * float(host.opt.impratio)",
           "a pyramid has two edges for each direction of friction", ("tests/test_contact.py::test_effective_masses",)),
    Defect("margin-twice", "mjx_study/simulation/contact.py",
           '"geom_margin": contact.margin / 2', '"geom_margin": contact.margin',
           "MuJoCo adds the margins of two geoms",
           ("tests/test_contact.py::test_contact_parameters_reach_every_contact",)),
    Defect("friction-of-a-pair", "mjx_study/simulation/contact.py",
           "jnp.stack([sliding, sliding, torsional, rolling, rolling])",
           "jnp.stack([sliding, torsional, torsional, rolling, rolling])",
           "a pair has five numbers where a geom has three",
           ("tests/test_contact.py::test_contact_parameters_reach_every_contact",)),
    Defect("half-critical-damping", "mjx_study/simulation/contact.py",
           "b = 2 * (dampratio or 0.0) * math.sqrt(k)", "b = (dampratio or 0.0) * math.sqrt(k)",
           "c = 2 zeta sqrt(k m) without its 2", ("tests/test_contact.py::test_a_damping_ratio_of_one_is_critical",)),
    Defect("trace-of-another-model", "mjx_study/digest.py",
           "(scene.adjoint, saved, scene.model, scene.template)", "(scene.adjoint, scene.template)",
           "a trace that an earlier run kept for one mass serves another",
           ("tests/test_compiled.py::test_what_differs_in_a_bit_has_a_trace_of_its_own",)),
    Defect("cost-after-the-step", "mjx_study/objective/cost.py",
           "return jax.tree.map(lambda leaf: leaf[:-1], states)",
           "return jax.tree.map(lambda leaf: leaf[1:], states)",
           "costs to go and scores of the states after the steps",
           ("tests/test_batches.py::test_costs_to_go_are_sums_of_remaining_costs",)),
    Defect("baseline-with-noise", "mjx_study/objective/batches.py",
           "np.append(np.repeat(signs, samples), np.zeros(len(zero_noise)))",
           "np.append(np.repeat(signs, samples), np.ones(len(zero_noise)))",
           "still unbiased with one sample less, and no error anywhere",
           ("tests/test_objective.py::test_baseline_is_the_cost_without_noise",)),
    Defect("costs-so-far", "mjx_study/objective/programs.py",
           "jnp.cumsum(running[::-1])[::-1] + final_cost", "jnp.cumsum(running) + final_cost",
           "costs up to a step in place of those from it on",
           ("tests/test_batches.py::test_costs_to_go_are_sums_of_remaining_costs",)),
    Defect("score-without-its-scale", "estimators/noise.py",
           "NOISES[density].score(noise / sigma) / sigma", "NOISES[density].score(noise / sigma)",
           "the score of standard noise; right at sigma = 1", ("tests/reference/test_objective.py",)),
    Defect("mean-of-all-as-baseline", "estimators/zeroth_first.py",
           "(jnp.sum(value) - value) / jnp.maximum(num_others, 1.0)",
           "jnp.sum(value) / (num_others + 1.0)",
           "the batch's mean depends on the sample: biased by 1/N", (UNBIASED,)),
    Defect("weights-swapped", "estimators/interpolation.py",
           "ratio = variance_first / jnp.where(variance_zeroth == 0, 1.0, variance_zeroth)",
           "ratio = variance_zeroth / jnp.where(variance_first == 0, 1.0, variance_first)",
           "each estimate weighed by its own variance", (CHOICE,)),
    Defect("variance-of-a-mixture", "estimators/interpolation.py",
           "(1.0 - alpha, alpha), ((1.0 - alpha) ** 2, alpha**2)",
           "(1.0 - alpha, alpha), (1.0 - alpha, alpha)",
           "variances weighed as means are", (VARIANCES, CHOICE)),
    Defect("bound-without-dimension", "estimators/confidence.py",
           "jnp.asarray((estimate.mean.shape[0] + 1) / failure_probability, dtype)",
           "jnp.asarray(2 / failure_probability, dtype)",
           "the scalar inequality used for a vector", ("tests/estimators/test_confidence.py", CHOICE)),
    Defect("laplace-score", "estimators/noise.py",
           "score=lambda z: jnp.sign(z) / LAPLACE_SCALE", "score=lambda z: jnp.sign(z)",
           "the score at scale 1, where the variance is 2", (STEPWISE,)),
    Defect("control-variate-scale", "estimators/zeroth_first.py",
           "linear = scale**2 * jnp.sum", "linear = scale * jnp.sum",
           "sigma in place of its square: unbiased still, but no longer a control variate", (VARIANCES, UNBIASED)),
    Defect("pairs-as-samples", "estimators/zeroth_first.py",
           "return summarise((above + below) / 2.0)",
           "return summarise(jnp.concatenate([above, below]))",
           "the halves of a pair are not independent: the same mean, another standard error", (VARIANCES, STEPWISE)),
    Defect("cut-one-step-early", "estimators/recursion.py",
           "jnp.arange(1, horizon + 1) % window != 0", "jnp.arange(horizon) % window != 0",
           "windows counted from the wrong end", (STEPWISE,)),
    Defect("range-slope", "mjx_study/reference/projectiles.py",
           "slope = 2 * self.speed**2 / self.gravity * np.cos(2 * angle)",
           "slope = self.speed**2 / self.gravity * np.cos(2 * angle)",
           "the inner derivative of sin(2 angle) forgotten", ("tests/reference/test_functions.py",)),
    Defect("adjoint-not-transposed", "mjx_study/reference/system.py",
           'cost_states[..., step, :] + np.einsum("...ij,...i->...j", over_state, adjoint)',
           'cost_states[..., step, :] + np.einsum("...ij,...j->...i", over_state, adjoint)',
           "the Jacobian in place of its transpose", ("tests/reference/test_gradients.py",)),
    Defect("coriolis-term", "mjx_study/reference/double_pendulum.py",
           "sine * v2 * (2 * v1 + v2) - 2 * pull", "sine * v2 * (v1 + v2) - 2 * pull",
           "a factor of two in a velocity product", ("tests/reference/test_double_pendulum.py",)),
    Defect("impact-of-a-fixed-paddle", "mjx_study/reference/tennis.py",
           "slope[:, :2] - slope[:, 4:6]) - along[:, None] * slope[:, 6]",
           "slope[:, :2] - slope[:, 4:6])",
           "the time of impact without the paddle's turning", ("tests/reference/test_gradients.py",)),
    Defect("jump-term-density", "mjx_study/reference/function.py",
           "density.density(copies(jump.position)).sum() / sigma",
           "density.density(copies(jump.position)).sum()",
           "the density of standard noise; right at sigma = 1", ("tests/reference/test_functions.py",)),
    Defect("first-order-variance", "experiments/linear_quadratic.py",
           "4 * sigma**2 * np.sum(square**2)", "4 * sigma**2 * np.trace(square) ** 2",
           "the square of a trace in place of the trace of a square", ("tests/reference/test_linear_quadratic.py",)),
)
