"""A task: a scene, where it starts, a policy, its noise, and a cost."""

import dataclasses
import math
from collections.abc import Callable
from typing import Final

import jax
from jaxtyping import Array, Float, Key

from mjx_study.reference import Reference
from mjx_study.reference.noise import check_density
from mjx_study.simulation.contact import effective_mass
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.onset import check_onset
from mjx_study.simulation.scene import Scene
from mjx_study.tasks.policy import Policy

STIFFNESSES: Final = (10.0, 100.0, 300.0, 550.0, 1000.0, 1200.0)
FAMILIES: Final = ("penalty", "mujoco", "mujoco_stiff")


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a task is optimised unless told otherwise.

    Attributes:
        learning_rate: of plain gradient descent.
        iterations: number of steps.
        samples: in each batch.
        decay: power a of the learning rate's decay, learning_rate / i^a at iteration i = 1, 2, ...
    """

    learning_rate: float
    iterations: int
    samples: int
    decay: float = 0.0


@dataclasses.dataclass(frozen=True)
class Published:
    """What the published example gives AoBG's bound epsilon + alpha B <= gamma, on the scale of this task's cost.

    Its confidence 0.95 stands in the logarithm where the Bernstein inequality has the probability of failure; the
    appendix bounds the variance by the second moment, whose printed sum must be a mean.

    Attributes:
        gamma: accuracy bound, in the unit of the gradient.
        radius: R in epsilon, a constant of each example, in the unit of the gradient.
        failure_probability: P in epsilon, as published.
        variance_proxy: s2 in epsilon.

    Reference: Suh et al. 2022, appendix "Empirical Bernstein confidence", with its published examples' numbers.
    """

    gamma: float
    radius: float
    failure_probability: float = 0.95
    variance_proxy: str = "second_moment"


def no_running_cost(state: State, control: Float[Array, " nu"]) -> Float[Array, ""]:
    """0: the steps cost nothing."""
    return jax.numpy.zeros((), state.qpos.dtype)


def no_final_cost(state: State) -> Float[Array, ""]:
    """0: the last state costs nothing."""
    return jax.numpy.zeros((), state.qpos.dtype)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Everything that defines F(theta) = E V_1 except the contact model.

    Attributes:
        name: as the command line takes it.
        description: one line.
        scene: the compiled model.
        horizon: number of steps H.
        policy: maps theta, noise and state to start and controls.
        theta: where gradients are taken unless told otherwise, (params,). A weakly typed array is made a strong one:
            otherwise what is compiled for it would be compiled again for the theta of a descent.
        sigma: standard deviation of the noise, in the unit of what it is added to.
        start: the start state, or a distribution over start states as a function of a key.
        running_cost: c(state, control) of each step before it is taken; none by default, where there is a final one.
        final_cost: c(state) after the last step; none by default, where there is a running one.
        contact_pair: names of the two geoms whose contact is swept; None where there is no contact.
        gamma: AoBG's accuracy bound, in the unit of the gradient; infinite by default, which is inverse-variance
            weighting.
        published: AoBG's constants in the published example; None where there are none.
        reference: the analytic system in place of the penalty family, as a function of the stiffness [N/m]; None where
            there is none. `analytic` gives it the task's noise.
        damping: of the contact in families without a damping ratio of their own [N s/m], or None; friction needs some,
            since it is the resistance to slip.
        stiffnesses: that a sweep takes unless told otherwise [N/m].
        families: contact families that a sweep takes unless told otherwise.
        span: range of a decision of one number that a landscape shows; None for a range about theta.
        noise: name of the noise's density in `estimators.NOISES`.
        onset: how first-order gradients take the onset of contact: "none", exact derivatives of the steps, or "linear",
            with what those miss (see `mjx_study.simulation.onset`).
        recipe: how it is optimised unless told otherwise; None where every number has to be given.
        outcomes: what a rollout came to, by name, from its states with the start first; what is reported of a policy
            beside its cost. None where the cost says it all.
    """

    name: str
    description: str = ""
    scene: Scene
    horizon: int
    policy: Policy
    theta: Float[Array, " params"]
    sigma: float
    start: State | Callable[[Key[Array, ""]], State]
    running_cost: Callable[[State, Float[Array, " nu"]], Float[Array, ""]] = no_running_cost
    final_cost: Callable[[State], Float[Array, ""]] = no_final_cost
    contact_pair: tuple[str, str] | None
    gamma: float = math.inf
    published: Published | None = None
    reference: Callable[[float], Reference] | None = None
    damping: float | None = None
    stiffnesses: tuple[float, ...] = STIFFNESSES
    families: tuple[str, ...] = FAMILIES
    span: tuple[float, float] | None = None
    noise: str = "gaussian"
    onset: str = "none"
    recipe: Recipe | None = None
    outcomes: Callable[[State], dict[str, Float[Array, ""]]] | None = None

    def __post_init__(self) -> None:
        theta = jax.numpy.asarray(self.theta)
        object.__setattr__(self, "theta", jax.numpy.asarray(theta, theta.dtype))
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 step, got {self.horizon}")
        check_sigma(self.sigma)
        check_density(self.noise)
        check_onset(self.onset)
        if not self.stiffnesses:
            raise ValueError(
                f"{self.name} needs at least one stiffness [N/m] to sweep; leave stiffnesses out otherwise"
            )
        if self.running_cost is no_running_cost and self.final_cost is no_final_cost:
            raise ValueError("a task needs a running_cost, a final_cost, or both")
        if self.theta.shape != (self.policy.num_params,):
            raise ValueError(f"theta has shape {self.theta.shape}, the policy needs ({self.policy.num_params},)")

    @property
    def random_start(self) -> bool:
        """Whether the start is drawn per sample."""
        return not isinstance(self.start, State)

    def analytic(self, stiffness: float) -> Reference:
        """The reference at a contact stiffness [N/m], with the task's own noise.

        Raises:
            ValueError: there is none.
        """
        if self.reference is None:
            raise ValueError(f"{self.name} has no analytic reference")
        return dataclasses.replace(self.reference(stiffness), sigma=self.sigma, noise=self.noise)  # type: ignore[type-var]

    @property
    def main_family(self) -> str:
        """The contact family of a single run unless told otherwise: MuJoCo's impedance where the task sweeps it."""
        return "mujoco" if "mujoco" in self.families else self.families[0]

    @property
    def middle_stiffness(self) -> float:
        """The stiffness of a single run unless told otherwise, the middle one of the sweep [N/m]."""
        return self.stiffnesses[len(self.stiffnesses) // 2]

    @property
    def effective_mass(self) -> float:
        """Of the swept contact along its normal [kg].

        Raises:
            ValueError: the task has no contact.
        """
        if self.contact_pair is None:
            raise ValueError(f"{self.name} has no contact whose stiffness could be set; use the contact family mjcf")
        return effective_mass(self.scene, *self.contact_pair)

    def draw_start(self, key: Key[Array, ""]) -> State:
        """The start state of one sample."""
        return self.start if isinstance(self.start, State) else self.start(key)

    def replace(self, **changes) -> "Task":
        """A copy with some attributes changed."""
        return dataclasses.replace(self, **changes)


def check_sigma(sigma: float) -> None:
    """Raises ValueError unless sigma is positive and finite."""
    if not 0 < sigma < math.inf:
        raise ValueError(f"sigma must be positive and finite, in the unit of what it is added to; got {sigma}")
