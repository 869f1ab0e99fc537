"""`benchmarks.gradient`: physics and derivative against the environments' flights and their differences."""

import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import envs
import ppo_gtrxl_di
import ppo_gtrxl_rocket
from benchmarks import gradient
from common.checkpoints import read_checkpoint
from rocket.comparison import fly_checkpoint
from rocket.metrics import evaluate_dispersed
from rocket.orbits import specific_energy

ROOT = Path(__file__).parents[1]
CUTOFF = "RocketAscentCutoff-v0"
COARSE = replace(envs.ROCKET, dt=10.0)  # steps of 10 s instead of 2: a fifth of the time


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def agent_of(script, env, **args):
    """A new agent of a script, a small MLP unless said."""
    torch.manual_seed(0)
    small = {"num_blocks": 0, "embed_dim": 16, "hidden_dim": 16, "num_heads": 2, "memory_length": 4, "mlp_dim": 16}
    return script.Agent(script.Args(**{**small, **args}), env).double()


def rockets(n, env_id=CUTOFF, **options):
    env = gym.make_vec(env_id, num_envs=n, action_frame="local", **options).unwrapped
    env.reset(seed=3)
    return env


def shipped(env):
    """The policy of the nominal flight, which has a memory."""
    path = ROOT / "results" / "rocket_cutoff" / "agent.safetensors"
    args = ppo_gtrxl_rocket.Args(**read_checkpoint(path)["args"])
    agent = ppo_gtrxl_rocket.Agent(args, env)
    agent.load_state_dict(safetensors.torch.load_file(path))
    return agent.double()


def ends_of(env, agent):
    """Ends (n, 7) and times (n,) of one flight in each environment, of the draws that it has."""
    obs, _ = env.reset(options={"draw": env.draw.copy()} if env.has_draws else None)
    policy, t = agent.make_policy(env.episode_steps), 0
    ends, times, running = np.zeros((env.num_envs, 7)), np.zeros(env.num_envs), np.ones(env.num_envs, dtype=bool)
    while running.any():
        obs, _, ended, _ = env.advance(policy(obs, t))
        t += 1
        ends[running & ended] = env.y.T[running & ended]
        times[running & ended] = env.time[running & ended]
        running &= ~ended
    return ends, times


# --- physics ----------------------------------------------------------------------------------------------------------


def test_the_double_integrators_costs_are_the_environments():
    env = gym.make_vec("DoubleIntegrator-v0", num_envs=50, **ppo_gtrxl_di.FIXED_OPTIONS).unwrapped
    agent = agent_of(ppo_gtrxl_di, env, env_id="DoubleIntegrator-v0")
    agent.actor[-1].weight.data *= 1000  # some controls are clipped
    x0 = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    flight = envs.fly("DoubleIntegrator-v0", agent.make_policy(50), x0, **ppo_gtrxl_di.FIXED_OPTIONS)
    assert 0.05 < (np.abs(flight["u"]) == 4).mean() < 0.95
    found = gradient.costs(agent, env.problem, torch.tensor(x0)).detach()
    np.testing.assert_allclose(found, flight["cost"], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"dispersion": 1.0}], ids=["nominal", "drawn"])
def test_steps_and_ends_are_the_environments(options):
    """Every step of flights to the orbit: three stagings, drawn vehicles, air and wind; then the cut-off, its time too.

    The environment finds the cut-off by regula falsi, `Physics.end` by Newton's method.
    """
    env = rockets(4 if options else 1, **options)
    agent = shipped(env)
    flights = gradient.fly(agent, env)
    T, n = flights.y.shape[:2]
    physics, here = gradient.Physics(env, T), (flights.last, torch.arange(n))
    assert len(physics.legs) == 2 and physics.legs[0].goes_on.sum() >= 3 and not flights.crashed
    after = physics.advance(np.arange(T), flights.y, flights.u)
    for k, last in enumerate(flights.last):
        assert last > 400
        np.testing.assert_allclose(after[:last, k], flights.y[1 : last + 1, k], rtol=1e-12, atol=1e-8)
    end = physics.end(flights.last, flights.y[here], flights.u[here])
    ends, times = ends_of(env, agent)
    np.testing.assert_allclose(end, ends, rtol=1e-12, atol=1e-7)
    flow, begin = physics.legs[0].flow[here], env.dt * flights.last
    burnt = (flights.y[here] - end)[:, 6]
    np.testing.assert_allclose(begin + burnt / flow, times, atol=1e-8)
    outcome = physics.outcome(flights.last, flights.y[here], flights.u[here])
    expected = np.column_stack([envs.terminal_error(ends, env.rocket), ends[:, 6] / 100])
    np.testing.assert_allclose(outcome, expected, atol=1e-11)


def test_a_vehicle_of_other_stages_is_the_environments():
    env = rockets(3, env_id="TwoStageLEO-v0", dispersion=1.0)
    flights = gradient.fly(agent_of(ppo_gtrxl_rocket, env, env_id="TwoStageLEO-v0"), env)
    T = int(flights.last.min())
    physics = gradient.Physics(env, T)
    assert T > 100 and physics.legs[0].goes_on.any()
    after = physics.advance(np.arange(T), flights.y[:T], flights.u[:T])
    np.testing.assert_allclose(after, flights.y[1 : T + 1], rtol=1e-12, atol=1e-8)


def test_a_flight_out_of_propellant_goes_on():
    """What is judged goes on to the target's energy, for at most `SPARE` seconds: straight up that is not enough."""
    env = rockets(1, rocket=COARSE)
    flights = gradient.fly(agent_of(ppo_gtrxl_rocket, env, env_id=CUTOFF), env)
    physics, y, u = gradient.Physics(env, len(flights.y)), flights.y[-1], flights.u[-1]
    last_step, flow = physics.legs[0].seconds[-1], physics.legs[0].flow[-1]
    end = physics.end(flights.last, y, u)
    np.testing.assert_allclose((y - end)[:, 6] / flow, last_step + gradient.SPARE)

    fast = y.clone()
    speed = (2 * (env.rocket.target_energy + env.rocket.mu / y[0, :3].norm())).sqrt() - 300.0  # m/s
    fast[0, 3:6] = speed * u[0]
    end = physics.end(flights.last, fast, u)
    assert last_step < (y - end)[0, 6] / flow < last_step + gradient.SPARE
    energy = specific_energy(end[0].numpy(), env.rocket.mu)
    np.testing.assert_allclose(energy, env.rocket.target_energy, rtol=1e-12)


# --- derivative -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("num_blocks", [0, 1])
def test_the_derivative_is_that_of_the_environments_flights(num_blocks, monkeypatch):
    """Central differences along a direction in the weights, of the outcome of drawn flights in the environments.

    The policy climbs straight up, which ends at the burn-out: nothing is to be continued here.
    """
    monkeypatch.setattr(gradient, "SPARE", 0.0)
    env = rockets(2, dispersion=1.0, rocket=COARSE)
    draw = env.draw.copy()
    monkeypatch.setattr(env, "reset", lambda **_: type(env).reset(env, options={"draw": draw}))
    agent = agent_of(ppo_gtrxl_rocket, env, env_id=CUTOFF, num_blocks=num_blocks)
    weights = gradient.weights_of(agent)
    outcome, J = gradient.derivative(agent, env, gradient.fly(agent, env))
    start = parameters_to_vector(weights).detach()
    direction, outcomes = torch.randn(len(start)), []
    for size in (1e-6, -1e-6):
        vector_to_parameters(start + size * direction, weights)
        ends, _ = ends_of(env, agent)
        outcomes.append(np.column_stack([envs.terminal_error(ends, env.rocket), ends[:, 6] / 100]))
    differences = (outcomes[0] - outcomes[1]) / 2e-6
    assert np.abs(differences[:, :6]).max() > 0.01
    np.testing.assert_allclose(J @ direction, differences, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(outcome, (outcomes[0] + outcomes[1]) / 2, atol=1e-6)


def test_the_cut_off_is_differentiated():
    """Error and mass of a flight that is cut off, by the state in which its last step begins."""
    env = rockets(1)
    flights = gradient.fly(shipped(env), env)
    physics, last = gradient.Physics(env, len(flights.y)), int(flights.last)
    y, u = flights.y[-1].requires_grad_(), flights.u[-1].requires_grad_()
    outcome = physics.outcome(flights.last, y, u)
    by_y, _ = gradient.by_rows(outcome, [y, u])
    env.action_frame = "eci"
    for k, size in enumerate([10.0, 10.0, 10.0, 0.01, 0.01, 0.01]):
        ends = []
        for sign in (1, -1):
            env.reset()
            env.t[:], env.y = last, y.detach().T.numpy().copy()
            env.y[k] += sign * size
            env.advance(u.detach().numpy())
            ends.append(np.append(envs.terminal_error(env.y[:, 0], env.rocket), env.y[6, 0] / 100))
        np.testing.assert_allclose(by_y[0, :, k], (ends[0] - ends[1]) / (2 * size), rtol=1e-4, atol=1e-11)


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_short_training_comes_nearer():
    """The environment flies the policy that was found; by flights that have crashed it is led no further astray."""
    env = rockets(1, rocket=COARSE)
    agent, curve = agent_of(ppo_gtrxl_rocket, env, env_id=CUTOFF, embed_dim=64, hidden_dim=64), gradient.Curve()
    gradient.train_rocket(agent, env, gradient.Recipe(updates=12, flights=1, learning_rate=2e-3), curve)
    flight = envs.fly_rocket(CUTOFF, agent.make_policy(env.episode_steps), action_frame="local", rocket=COARSE)
    assert flight["error_norm"] < 0.6 * curve.points[0]["error_median"]
    assert [point["flights"] for point in curve.points] == list(range(1, 13))


@pytest.mark.slow
def test_a_training_of_the_double_integrator_costs_less():
    env, _ = gradient.make_envs(gradient.ROWS["di"], 64, 1)
    agent = agent_of(ppo_gtrxl_di, env, env_id="DoubleIntegrator-v0")
    x0 = torch.rand(100, 2) * 2 - 1
    before = gradient.costs(agent, env.problem, x0).mean()
    gradient.train_problem(agent, env, gradient.Recipe(updates=60, flights=64, learning_rate=1e-2), gradient.Curve())
    assert gradient.costs(agent, env.problem, x0).mean() < before / 5


# --- command ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "argv, line",
    [
        (["vdp"], "invalid choice: 'vdp'"),
        (["cutoff", "--seed", "0"], "'0' must be a whole number from 1"),
        (["cutoff", "--save", "nowhere/agent.safetensors"], "must be a file in an existing, writable folder"),
    ],
)
def test_bad_input_is_one_line(argv, line, monkeypatch):
    monkeypatch.setattr(gradient, "train", None)
    monkeypatch.setattr(sys, "argv", ["gradient.py", *argv])
    with pytest.raises(SystemExit, match=line) as refusal:
        gradient.main()
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_the_saved_policy_flies_as_a_law_of_the_comparison(tmp_path, monkeypatch):
    """A dispersed training of one update: its file is one of the script's, which flies it on the draws of the laws."""
    short = {"recipe": gradient.Recipe(updates=1, flights=2, learning_rate=1e-3)}
    for name in ("cutoff", "dispersed"):
        monkeypatch.setitem(gradient.ROWS, name, replace(gradient.ROWS[name], **short))
    path, curve = tmp_path / "agent.safetensors", gradient.Curve()
    agent, args = gradient.train("dispersed", 1, curve)
    path.write_bytes(gradient.policy_file(agent, args, curve, short["recipe"]))
    arrays, about = fly_checkpoint(path, 1.0, 0, 10)
    assert about["knows"] == "draws in training"
    assert ppo_gtrxl_rocket.has_nominal_flight(agent)
    _, expected = evaluate_dispersed(CUTOFF, agent.make_policy(600), 0, 10, 1.0, action_frame="local")
    np.testing.assert_allclose(arrays["final_error"], expected["final_error"], atol=1e-5)


# --- the records that are shipped -------------------------------------------------------------------------------------
