"""A task: a scene, an initial state, a policy, its noise, and a cost."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from estimators.noise import check_density, check_sigma
from estimators.user_code import describe_error
from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.reference import ReferenceObjective
from mjx_study.simulation.contact import ContactModel, effective_mass
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.observation import ObservedState, observed
from mjx_study.simulation.onset import check_onset
from mjx_study.simulation.scene import Scene
from mjx_study.tasks.policy import Policy


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Default settings for the optimisation of a task.

    Attributes:
        learning_rate: learning rate of the optimiser.
        iterations: number of descent steps.
        samples: batch size of the gradient estimate at each step.
        decay: exponent a of the learning-rate decay, learning_rate / i^a at iteration i = 1, 2, ...
        optimizer: name of an optimiser of optax; "sgd" is plain gradient descent.
    """

    learning_rate: float
    iterations: int
    samples: int
    decay: float = 0.0
    optimizer: str = dataclasses.field(default="sgd", metadata={"later": True})


@dataclasses.dataclass(frozen=True)
class Published:
    """Constants of the published example in AoBG's bound epsilon + alpha B <= gamma, on this task's cost scale.

    The example uses its confidence 0.95 in the logarithm instead of the Bernstein inequality's failure probability. The
    appendix bounds the variance by the second moment, whose printed sum must be a mean.

    Attributes:
        gamma, radius: accuracy bound, and R in epsilon, in the unit of the gradient.
        failure_probability, variance_proxy: P and s2 in epsilon.

    Reference: Suh et al. 2022, appendix "Empirical Bernstein confidence", with its published examples' numbers.
    """

    gamma: float
    radius: float
    failure_probability: float = 0.95
    variance_proxy: str = "second_moment"


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyDefaults:
    """Defaults for studies of a task.

    Attributes:
        families: contact families, names in `FAMILIES`.
        stiffnesses: contact stiffnesses [N/m].
        damping: contact damping in families without a damping ratio [N s/m], or None; friction needs some, since it is
            the resistance to slip.
        gamma: AoBG's accuracy bound, in the unit of the gradient; infinite by default (inverse-variance weighting).
        published: AoBG's constants in the published example, or None.
        recipe: settings of descents; None if they must all be given.
        span: range of a landscape over a scalar parameter; None for a range about theta.
    """

    families: tuple[str, ...] = ("penalty", "mujoco", "mujoco_stiff")
    stiffnesses: tuple[float, ...] = (10.0, 100.0, 300.0, 550.0, 1000.0, 1200.0)
    damping: float | None = None
    gamma: float = math.inf
    published: Published | None = None
    recipe: Recipe | None = None
    span: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.stiffnesses:
            raise ValueError("give at least one stiffness [N/m], or omit stiffnesses")

    @property
    def main_family(self) -> str:
        """Contact family of single runs: MuJoCo's impedance if it is among the families."""
        return "mujoco" if "mujoco" in self.families else self.families[0]

    @property
    def middle_stiffness(self) -> float:
        """Stiffness of single runs [N/m]: the middle one."""
        return self.stiffnesses[len(self.stiffnesses) // 2]


def no_cost(state: State, control: Float[Array, " nu"] | None = None) -> Float[Array, ""]:
    return jnp.zeros((), state.qpos.dtype)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Everything that defines F(theta) = E V_1 except the contact model.

    Attributes:
        name: name on the command line.
        description: one line, for tables and reports; by default that of the built-in task of this name.
        scene: the compiled model; a contact model replaces its contact parameters.
        horizon: number of steps H.
        policy: maps theta, noise and state to initial state and controls.
        theta: default parameters, where gradients are taken, (params,). Weakly typed arrays are made strongly typed to
            avoid recompilation for the theta of a descent.
        sigma: standard deviation of the noise, in the unit of the quantity it is added to.
        start: initial state, or a function of a key that draws one.
        running_cost: c(state, control) of each step, evaluated before the step; optional if there is a final cost. The
            state is an `ObservedState`, which knows bodies, contact forces and sensors.
        final_cost: c(state) after the last step, likewise; optional if there is a running cost.
        contact_pair: names of the two geoms whose contact is swept; None without contact.
        reference: function of the stiffness [N/m] that returns the analytic counterpart of the penalty family, or None;
            `analytic` adds the task's noise.
        noise: name of the noise density in `estimators.NOISES`.
        onset: treatment of the onset of contact in first-order gradients: "none" for exact derivatives of the steps, or
            "linear" or "shift" to add what those miss (see `mjx_study.simulation.onset`).
        metrics: function that computes named metrics of a rollout, reported along with the cost, from its states
            including the initial one, (horizon + 1, ...), likewise; None for none.
        defaults: defaults for studies of the task.
    """

    name: str
    description: str = ""
    scene: Scene
    horizon: int
    policy: Policy
    theta: Float[Array, " params"]
    sigma: float
    start: State | Callable[[Key[Array, ""]], State]
    running_cost: Callable[[ObservedState, Float[Array, " nu"]], Float[Array, ""]] = no_cost
    final_cost: Callable[[ObservedState], Float[Array, ""]] = no_cost
    contact_pair: tuple[str, str] | None
    reference: Callable[[float], ReferenceObjective] | None = None
    noise: str = "gaussian"
    onset: str = "none"
    metrics: Callable[[ObservedState], dict[str, Float[Array, ""]]] | None = None
    defaults: StudyDefaults = StudyDefaults()

    def __post_init__(self) -> None:
        object.__setattr__(self, "description", self.description or TASK_DESCRIPTIONS.get(self.name, ""))
        theta = jnp.asarray(self.theta)
        object.__setattr__(self, "theta", jnp.asarray(theta, theta.dtype))
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 step, got {self.horizon}")
        check_sigma(self.sigma)
        check_density(self.noise)
        check_onset(self.onset)
        if self.running_cost is self.final_cost is no_cost:
            raise ValueError("a task needs a running_cost, a final_cost, or both")
        if self.theta.shape != (self.policy.num_params,):
            raise ValueError(f"theta has shape {self.theta.shape}, the policy needs ({self.policy.num_params},)")

    @property
    def random_start(self) -> bool:
        """Whether every sample draws its own initial state."""
        return not isinstance(self.start, State)

    def analytic(self, stiffness: float) -> ReferenceObjective:
        """The reference at a contact stiffness [N/m], with the task's noise; a ValueError if there is none."""
        if self.reference is None:
            raise ValueError(f"{self.name} has no analytic reference")
        return dataclasses.replace(self.reference(stiffness), sigma=self.sigma, noise=self.noise)

    @property
    def effective_mass(self) -> float:
        """Effective mass of the swept contact along its normal [kg]; a ValueError if the task has none."""
        if self.contact_pair is None:
            raise ValueError(
                f"{self.name} names no contact whose stiffness could be set: use the contact family mjcf, or a task "
                "with a contact_pair, as mjx-study init writes for an MJCF"
            )
        return effective_mass(self.scene, *self.contact_pair)

    def draw_start(self, key: Key[Array, ""]) -> State:
        """Initial state, drawn with the key if it is random."""
        return self.start if isinstance(self.start, State) else self.start(key)

    def costs(
        self, contact: ContactModel | None = None
    ) -> tuple[Callable[[State, Float[Array, " nu"]], Float[Array, ""]], Callable[[State], Float[Array, ""]]]:
        """The running_cost and final_cost of plain states, which they are given as `ObservedState`s.

        Args:
            contact: the contact model of forces and sensors; None for the MJCF's.
        """

        def running_cost(state: State, control: Array) -> Array:
            return self.running_cost(observed(self.scene, state, contact, control), control)

        def final_cost(state: State) -> Array:
            return self.final_cost(observed(self.scene, state, contact))

        return running_cost, final_cost

    def replace(self, **changes) -> "Task":
        return dataclasses.replace(self, **changes)


def check_shapes(task: Task, name: str = "") -> None:
    """Raise ValueError for mismatches that broadcasting and clamped indices would hide; traces only.

    The name, by default the task's, begins the message.
    """
    name = name or task.name
    policy, dtype = task.policy, task.scene.template.qpos.dtype
    steps, controls = task.horizon, task.scene.host.nu
    if jnp.asarray(task.theta).dtype != dtype:
        raise ValueError(f"{name}: theta is {task.theta.dtype}, and the simulation {dtype}")
    start = _traced(name, "start", lambda: task.draw_start(jax.random.key(0)))
    noise = jax.ShapeDtypeStruct(policy.noise_shape, dtype)
    control = jax.ShapeDtypeStruct((controls,), dtype)
    placed = _traced(name, "policy's place", policy.place, task.theta, noise, start)
    for leaf in ("qpos", "qvel", "act"):
        found, needed = getattr(placed, leaf).shape, getattr(task.scene.template, leaf).shape
        if found != needed:
            raise ValueError(f"{name}: {leaf} of the start has shape {found}; the scene needs {needed}")
    running_cost, final_cost = task.costs()
    parts = {
        "policy's feedforward": (policy.feedforward, (task.theta, noise), (steps, controls)),
        "policy's feedback": (policy.feedback, (task.theta, start), (controls,)),
        "running_cost": (running_cost, (start, control), ()),
        "final_cost": (final_cost, (start,), ()),
    }
    for part, (function, arguments, needed) in parts.items():
        found = _traced(name, part, function, *arguments)
        if found is None and part == "policy's feedback":
            continue
        if (shape := getattr(found, "shape", None)) != needed:
            fitting = f"; {steps} steps and {controls} controls need {needed}" if needed else ", and a cost is a scalar"
            got = f"has shape {shape}" if shape is not None else f"returns a {type(found).__name__}, not an array"
            raise ValueError(f"{name}: the {part} {got}{fitting}")


def _traced(name: str, part: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{name}: the {part} raised {describe_error(error)}") from error
