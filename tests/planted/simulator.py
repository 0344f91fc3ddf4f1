"""Defects of the step, the patches of MJX, its constraints and its contact models."""

from typing import Final

from tests.planted.defect import Defect

STEP = "tests/test_dynamics.py"
GRAPHS = "tests/test_graph_derivatives.py"
VALUES, SLOPES = "test_the_step_is_mjxs", "test_reverse_mode_is_the_central_difference"
LAWS = "tests/test_constraint.py::test_forces_and_imbalance_are_those_of_mjx"
IMPEDANCE = "tests/test_patches.py::test_stiffness_damping_and_impedance_are_the_c_engines"
CONE = "tests/test_constraint.py::test_the_elliptic_law_is_the_gradient_of_a_convex_cost"

DYNAMICS: Final = (
    Defect(
        "constants-by-shape",
        "mjx_study/graph/scalars.py",
        "return array.shape, array.dtype.str, array.tobytes()",
        "return array.shape, array.dtype.str",
        "a graph with the constants of one model serves another of the same shapes",
        ("tests/test_graph.py::test_a_function_is_written_out_once_for_arguments_of_equal_content",),
    ),
    Defect(
        "frame-without-derivative",
        "mjx_study/simulation/dynamics.py",
        "        return mjx.fwd_position(model, data)\n",
        """        data = mjx.fwd_position(model, data)
        frame = jax.lax.stop_gradient(data._impl.contact.frame)
        return data.tree_replace({"_impl.contact.frame": frame})
""",
        "the contact frame taken for a constant, as it is on a plane",
        (f"{STEP}::{SLOPES}[sphere-sphere condim 6 elliptic implicitfast]",),
        "dome",
    ),
    Defect(
        "reference-at-rest",
        "mjx_study/simulation/dynamics.py",
        "        data = mjx.make_constraint(model, data)  # again: aref depends on qvel\n",
        "",
        "an apparently repeated call removed",
        (f"{STEP}::{VALUES}[sphere-sphere condim 1]",),
        "slider",
    ),
    Defect(
        "implicit-part-dropped",
        "mjx_study/graph/linear_map.py",
        "return pull(graph, [gap, *results], inputs, [of_gap, *adjoints[:-1]])",
        "return pull(graph, results, inputs, adjoints[:-1])",
        "the step differentiated at a fixed acceleration",
        (f"{STEP}::{SLOPES}[sphere-sphere condim 1]", f"{GRAPHS}::test_the_implicit_derivative_is_that_of_the_loop"),
        "slider",
    ),
    Defect(
        "columns-swapped",
        "mjx_study/simulation/dynamics.py",
        "return step_change(scene, whole(traced), tuple(point), qacc, moved)",
        "return step_change(scene, whole(traced), tuple(point), qacc, (*moved[:3], moved[3][::-1]))",
        "controls in another order than the actuators",
        (f"{STEP}::test_activation_and_control_each_have_their_column",),
        "mechanism",
    ),
    Defect(
        "quotient-without-its-denominator",
        "mjx_study/graph/differentiation.py",
        "slope = scalar(lax.neg_p, scalar(lax.mul_p, node, inverse)) if place else inverse",
        "slope = scalar(lax.neg_p, node) if place else inverse",
        "the quotient rule from memory",
        (f"{GRAPHS}::test_operations_have_jaxs_derivative[div]",),
        "slider",
    ),
    Defect(
        "ties-to-one-side",
        "mjx_study/graph/differentiation.py",
        "ties, strict, dtype.type(0.5)",
        "ties, strict, dtype.type(1)",
        "both arguments of a maximum count in full where they are equal",
        (f"{GRAPHS}::test_operations_have_jaxs_derivative[max]",),
    ),
    Defect(
        "case-not-taken",
        "mjx_study/graph/differentiation.py",
        "return which, bool(case)",
        "return which, not case",
        "the cases of a selection in the order of `where`, which is the other one",
        (f"{GRAPHS}::test_what_a_selection_leaves_out_does_not_count_in_reverse_mode",),
        "slider",
    ),
    Defect(
        "always-euler",
        "mjx_study/simulation/dynamics.py",
        "mjx.implicit(model, data) if implicit else mjx.euler(model, data)",
        "mjx.euler(model, data)",
        "one integrator forgotten",
        (f"{STEP}::test_a_velocity_servo_is_implicit_under_implicitfast",),
        "dome",
    ),
    Defect(
        "force-left-out-of-damping",
        "mjx_study/simulation/dynamics.py",
        "data.replace(qacc=qacc, qfrc_constraint=constraint.constraint_force(model, data, qacc))",
        "data.replace(qacc=qacc)",
        "Euler's implicit damping solves again, with the constraint force, which is easily forgotten",
        (f"{STEP}::{VALUES}[mechanism]",),
        "mechanism",
    ),
    Defect(
        "runge-kutta-weights",
        "mjx_study/simulation/dynamics.py",
        "(a + 2 * b + 2 * c + d) / 6",
        "(a + 3 * b + 3 * c + d) / 8",
        "the weights of the other rule of order four",
        (f"{STEP}::test_runge_kutta_is_mjxs",),
        "swing",
    ),
    Defect(
        "runge-kutta-stage",
        "mjx_study/simulation/dynamics.py",
        "third = slopes(*moved(0.5, second))",
        "third = slopes(*moved(0.5, first))",
        "a stage started from the wrong slope",
        (f"{STEP}::test_runge_kutta_is_mjxs",),
        "swing",
    ),
)

CONSTRAINT: Final = (
    Defect(
        "elliptic-sliding-direction",
        "mjx_study/simulation/constraint.py",
        "-magnitude * friction * tangent / safe_length",
        "-magnitude * friction * jax.lax.stop_gradient(tangent / safe_length)",
        "the direction of sliding held fixed; only a slide that turns shows it",
        (CONE,),
        "slider",
    ),
    Defect(
        "elliptic-friction-scale",
        "mjx_study/simulation/constraint.py",
        "-magnitude * friction * tangent / safe_length",
        "-magnitude * tangent / safe_length",
        "the cone's scaling of its axes applied once in place of twice",
        (CONE,),
        "slider",
    ),
    Defect(
        "impratio-forgotten",
        "mjx_study/simulation/constraint.py",
        "mu = friction[0] / jnp.sqrt(model.opt.impratio)",
        "mu = friction[0]",
        "right at the default impratio of 1",
        (f"{LAWS}[elliptic-condim-3,-4,-6]",),
        "slider",
    ),
    Defect(
        "friction-loss-one-sided",
        "mjx_study/simulation/constraint.py",
        "jnp.clip(linear, -loss, loss)",
        "jnp.clip(linear, 0.0, loss)",
        "friction taken for a unilateral force",
        (f"{LAWS}[mechanism]",),
        "mechanism",
    ),
    Defect(
        "equality-only-pushes",
        "mjx_study/simulation/constraint.py",
        "kind[: rows.ne] = 2",
        "kind[: rows.ne] = 0",
        "an equality taken for a contact",
        (f"{LAWS}[mechanism]",),
        "mechanism",
    ),
    Defect(
        "cholesky-off-by-one",
        "mjx_study/simulation/linear_algebra.py",
        "sum(upper[k][j] ** 2 for k in range(j))",
        "sum(upper[k][j] ** 2 for k in range(1, j))",
        "an index from 1",
        ("tests/test_constraint.py::test_solve_positive_definite",),
        "slider",
    ),
)

REPAIRS: Final = (
    Defect(
        "stiffness-over-d-width",
        "mjx_study/simulation/patches.py",
        "1 / product**2) / high**2",
        "1 / product**2) / high",
        "k divided by d_width in place of its square",
        (IMPEDANCE,),
        "slider",
    ),
    Defect(
        "impedance-above-midpoint",
        "mjx_study/simulation/patches.py",
        "** power / (1 - midpoint) ** (power - 1)",
        "** power / midpoint ** (power - 1)",
        "right at the default midpoint of 0.5",
        (IMPEDANCE,),
        "slider",
    ),
    Defect(
        "impedance-of-one-sign",
        "mjx_study/simulation/patches.py",
        "depth = jnp.abs(position) / width",
        "depth = -position / width",
        "right for contacts, wrong for equalities, which err to both sides",
        (IMPEDANCE,),
        "mechanism",
    ),
    Defect(
        "refsafe-at-one-timestep",
        "mjx_study/simulation/patches.py",
        "jnp.maximum(timeconst, 2 * model.opt.timestep)",
        "jnp.maximum(timeconst, model.opt.timestep)",
        "a factor of two forgotten",
        (IMPEDANCE,),
    ),
    Defect(
        "rotation-difference-reversed",
        "mjx_study/simulation/patches.py",
        "return rotation_between(start, end)",
        "return rotation_between(end, start)",
        "arguments in the order of MJX's own function",
        ("tests/test_patches.py::test_a_rotation_has_its_derivative_at_no_angle",),
        "ball",
    ),
    Defect(
        "tendon-spring-sign",
        "mjx_study/simulation/patches.py",
        "(stiffness * (shortest - data.ten_length))",
        "(stiffness * (data.ten_length - shortest))",
        "no effect on any value",
        ("tests/test_patches.py::test_tendon_springs_are_linear_at_rest",),
        "tendon",
    ),
)

INTEGRATION: Final = (
    Defect(
        "sine-series-coefficient",
        "mjx_study/simulation/integration.py",
        "0.5 - square / 48 +",
        "0.5 - square / 24 +",
        "a wrong coefficient of a series, used below 0.01 rad",
        ("tests/test_integration.py::test_values_are_scipys_and_mjxs",),
        "ball",
    ),
    Defect(
        "rotation-in-the-world-frame",
        "mjx_study/simulation/integration.py",
        "w * a + x * cosine + y * c - z * b",
        "w * a + x * cosine - y * c + z * b",
        "one entry of the product in the other order",
        ("tests/test_integration.py::test_values_are_scipys_and_mjxs",),
        "ball",
    ),
    Defect(
        "long-way-round",
        "mjx_study/simulation/integration.py",
        "jnp.where(real < 0, -real, real), jnp.where(real < 0, -axis, axis)",
        "jnp.where(real < 0, -real, real), axis",
        "q and -q are one orientation, and both parts change sign",
        ("tests/test_patches.py::test_both_quaternions_of_an_orientation_are_one",),
        "ball",
    ),
)

CONTACT: Final = (
    Defect(
        "edges-of-the-pyramid",
        "mjx_study/simulation/contact.py",
        "return 2 * (pair.condim - 1) * float(host.opt.impratio)",
        "return (pair.condim - 1) * float(host.opt.impratio)",
        "a pyramid has two edges for each direction of friction",
        ("tests/test_contact.py::test_effective_masses",),
    ),
    Defect(
        "margin-twice",
        "mjx_study/simulation/contact.py",
        '"geom_margin": contact.margin / 2',
        '"geom_margin": contact.margin',
        "MuJoCo adds the margins of two geoms",
        ("tests/test_contact.py::test_contact_parameters_reach_every_contact",),
    ),
    Defect(
        "friction-of-a-pair",
        "mjx_study/simulation/contact.py",
        "jnp.stack([sliding, sliding, torsional, rolling, rolling])",
        "jnp.stack([sliding, torsional, torsional, rolling, rolling])",
        "a pair has five numbers where a geom has three",
        ("tests/test_contact.py::test_contact_parameters_reach_every_contact",),
    ),
    Defect(
        "half-critical-damping",
        "mjx_study/simulation/contact.py",
        "b = 2 * (dampratio or 0.0) * math.sqrt(k)",
        "b = (dampratio or 0.0) * math.sqrt(k)",
        "c = 2 zeta sqrt(k m) without its 2",
        ("tests/test_contact.py::test_a_damping_ratio_of_one_is_critical",),
    ),
)

SIMULATOR: Final = (*DYNAMICS, *CONSTRAINT, *REPAIRS, *INTEGRATION, *CONTACT)
