"""A network as policy: its sizes, its score against differentiation, and a run with it from command to replay."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study import cli
from mjx_study.simulation.dynamics import State
from mjx_study.tasks import make_task
from mjx_study.tasks.network import Network, with_network


def network() -> Network:
    return Network(5, 2, 3, lambda state: state.qpos, (4, 3))


def test_parameters_are_laid_out_layer_by_layer() -> None:
    """By NumPy, with every weight and bias in its place."""
    policy = network()
    assert policy.num_params == 4 * 4 + 5 * 3 + 4 * 2 and policy.noise_shape == (5, 2)
    theta = np.asarray(jax.random.normal(jax.random.key(0), (policy.num_params,)))
    x = np.array([0.3, -0.2, 0.9])
    state = State(jnp.asarray(x), jnp.zeros(3), jnp.zeros(0), jnp.zeros(3))
    first = np.tanh(x @ theta[:12].reshape(3, 4) + theta[12:16])
    second = np.tanh(first @ theta[16:28].reshape(4, 3) + theta[28:31])
    expected = second @ theta[31:37].reshape(3, 2) + theta[37:]
    np.testing.assert_allclose(policy.feedback(jnp.asarray(theta), state), expected, rtol=1e-12)


def test_the_score_is_the_jacobian_times_the_noise() -> None:
    policy = network()
    theta = jax.random.normal(jax.random.key(1), (policy.num_params,))
    qpos, noise = jax.random.normal(jax.random.key(2), (5, 3)), jax.random.normal(jax.random.key(3), (5, 2))
    states = State(qpos, jnp.zeros((5, 3)), jnp.zeros((5, 0)), jnp.zeros((5, 3)))
    jacobian = jax.vmap(lambda state: jax.jacrev(lambda at: policy.feedback(at, state))(theta))(states)
    expected = jnp.einsum("hup,hu->p", jacobian, noise)
    np.testing.assert_allclose(policy.score(theta, states, noise), expected, rtol=1e-10)


def test_it_starts_without_control_and_sees_what_linear_feedback_sees() -> None:
    task = with_network(make_task("tennis", horizon=3), (8,), jax.random.key(4))
    assert isinstance(task.policy, Network) and task.policy.num_features == 7
    assert task.theta.shape == (8 * 8 + 9 * 3,)
    state = task.draw_start(jax.random.key(5))
    np.testing.assert_array_equal(task.policy.feedback(task.theta, state), np.zeros(3))
    assert with_network(make_task("pusher", horizon=3), (8,), jax.random.key(6)).policy.num_params == 8 * 5 + 9


def test_what_cannot_be_a_network_is_refused() -> None:
    with pytest.raises(ValueError, match="ball_wall has no control for a network to set"):
        with_network(make_task("ball_wall", horizon=3), (8,), jax.random.key(7))
    with pytest.raises(ValueError, match=r"at least 1 unit each, got \(4, 0\)"):
        with_network(make_task("pusher", horizon=3), (4, 0), jax.random.key(8))


@pytest.mark.slow
def test_a_network_is_optimised_and_replayed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["optimise", "pusher", "--network", "4", "--estimators", "fobg", "--horizon", "60", "--iterations", "8"]
    arguments += ["--contact", "penalty", "--stiffness", "100", "--optimizer", "adam", "--learning-rate", "0.02"]
    arguments += ["--samples", "4", "--seeds", "2", "--evaluation-samples", "4", "--output", str(out), "--json"]
    assert cli.main(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    (run,) = document["runs"]
    assert max(run["final_cost"]) < document["start_cost"][0]
    policy = out / "policy-fobg.json"
    replay = ["rollout", "pusher", "--theta", str(policy), "--frames", "1", "--json"]
    assert cli.main([*replay, "--output", str(tmp_path / "replay")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["theta"] == json.loads(policy.read_text())["theta"] and len(facts["theta"]) == 25
    assert facts["cost"] < document["start_cost"][0]
