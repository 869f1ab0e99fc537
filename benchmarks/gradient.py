"""What it costs not to know the derivative: policies trained by the gradient through the physics, beside PPO's.

    python -m benchmarks.gradient di --seed 1           # the double integrator: a minute of one core
    python -m benchmarks.gradient cutoff --seed 1       # the nominal rocket with cut-off: three minutes
    python -m benchmarks.gradient dispersed --seed 1    # from there on, every flight another vehicle: five minutes
    python -m benchmarks.gradient gtrxl --seed 1        # the nominal rocket by PPO's network with memory: ten minutes
    python -m benchmarks.gradient                       # prints what is in results/peers, with our PPO beside it
    python -m benchmarks.gradient dispersed --save runs/gradient.safetensors
    python evaluate.py opponents results/rocket_dispersed --also gradient=runs/gradient.safetensors

PPO tries actions and learns from what they earn. With the equations of motion one can compute how the end of a flight
changes with each weight of the policy. We use the environments' equations. With torch tensors in place of NumPy arrays
autograd differentiates them, with stagings, cut-off, drawn vehicles and wind. The network is the scripts' `Agent`,
which is an MLP if it has no blocks. Its features and its evaluation are the scripts', too. So a row differs from PPO's
row in its training and in its knowledge: it is given the model, as the classical laws are.

Reading order: double integrator, rocket's physics, flights, derivative, training, rows, table and command.
T is the number of steps, n of flights, W of weights. Training is in float64. The saved and evaluated policy is in
float32, as everywhere.
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import evaluate
import ppo_gtrxl_rocket
from benchmarks.policies import ROOT, environment_options, script_of
from benchmarks.records import cell, provenance, read_record
from common.checkpoints import read_checkpoint
from common.command_line import OneLineParser, integer, output_file
from common.evaluations import read_json
from common.files import write_bytes, write_json
from common.flags import plain_args
from common.flying import decision_us, fly_until_ended
from common.integration import rk4
from common.tasks import task_of
from rocket.dynamics import ascent_dynamics
from rocket.orbits import orbit_vectors, specific_energy, target_axes, target_orbit

# ---------------------------------------------------------------------------------------------------------------------
# The double integrator
# ---------------------------------------------------------------------------------------------------------------------


def costs(agent, problem, x0):
    """The costs (n,) of flights from the starts x0 (n, states), of a table of one phase with one control.

    They are those of the environment: the same dynamics by the same integrator.
    """
    phase = problem.phases[0]
    Q, target = torch.tensor(phase.Q), torch.tensor(phase.target)
    x, cost = x0, 0.0
    for t in range(problem.steps):
        clock = torch.full((len(x), 1), t / problem.steps)
        action = agent.get_mean_action(agent.encode_step(torch.cat([x, clock], dim=1), [], t))
        u = (action[:, 0] * problem.u_unit.item()).clamp(-problem.u_max, problem.u_max)
        cost = cost + ((x - target) ** 2 * Q).sum(dim=1) + phase.R * u**2
        x = torch.stack(rk4(problem.f, x.unbind(dim=1), u, problem.dt), dim=1)
    return cost + phase.Qf * ((x - target) ** 2).sum(dim=1)


# ---------------------------------------------------------------------------------------------------------------------
# The rocket's physics
# ---------------------------------------------------------------------------------------------------------------------

SPARE = 100.0  # s


class Leg(NamedTuple):
    """The parts of steps between two events, in all steps of n flights: (T, n) each unless a comment says otherwise."""

    seconds: torch.Tensor
    thrust: torch.Tensor  # N
    flow: torch.Tensor  # kg/s
    dropped: torch.Tensor  # (T, n, 7): kg that leave at its end, in the place of the mass
    goes_on: np.ndarray  # (T,) whether another leg follows in the same step of any flight


def legs_of(env, T: int) -> list[Leg]:
    """The legs of the vehicles that the last reset drew. Events come by the clock, so steering does not change them."""
    vehicles, who = env.vehicles, np.arange(env.num_envs)
    step = np.arange(T)[:, None]
    at = np.minimum(env.dt * step, vehicles.burn_out)  # (T, n)
    end = np.minimum(env.dt * (step + 1), vehicles.burn_out)
    arc = (vehicles.end[:, None] <= at).sum(axis=0)
    legs = []
    while not legs or legs[-1].goes_on.any():
        event = vehicles.end[arc, who]
        is_met = event <= end
        until = np.where(is_met, event, end)
        dropped = torch.tensor(vehicles.dropped[arc, who] * is_met)
        numbers = map(torch.tensor, (until - at, vehicles.thrust[arc, who], vehicles.flow[arc, who]))
        legs.append(Leg(*numbers, F.pad(dropped[..., None], (6, 0)), is_met.any(axis=1)))
        at = until
        arc = np.minimum(arc + is_met, len(vehicles.end) - 1)
    return legs


class Physics:
    """A rocket's steps in torch, of states y (..., 7) and unit directions u (..., 3), both in ECI."""

    def __init__(self, env, T: int):
        self.rocket, self.legs = env.rocket, legs_of(env, T)
        air = (torch.tensor(env.vehicles.wind), torch.tensor(env.vehicles.drag))
        self.air = air if env.dispersion else (None, None)
        self.normal = torch.tensor(target_axes(env.rocket)[2])
        self.h_target, self.e_target = map(torch.tensor, target_orbit(env.rocket.target, env.rocket.mu))

    def rates(self, x, controls):
        return ascent_dynamics(x, controls, self.rocket, *self.air)

    def burn(self, y, u, seconds, thrust, flow):
        """States `seconds` later, without an event between: one RK4 step, as the environment's."""
        x = rk4(self.rates, y.unbind(dim=-1), (*u.unbind(dim=-1), thrust, flow), seconds)
        return torch.stack(x, dim=-1)

    def advance(self, steps, y, u, leg: int = 0):
        """States (S, n, 7) at the ends of steps (S,), from the states and directions (S, n, 3) at their begins."""
        part = self.legs[leg]
        y = self.burn(y, u, part.seconds[steps], part.thrust[steps], part.flow[steps]) - part.dropped[steps]
        on = np.flatnonzero(part.goes_on[steps])
        if not len(on):
            return y
        rest = self.advance(steps[on], y[on], u[on], leg + 1)  # of 0 s in flights without an event
        return y.index_copy(0, torch.tensor(on), rest)

    def end(self, last, y, u):
        """The flights' ends (n, 7), from the states and directions at the begins of their last steps (n,).

        A flight ends at the target's energy. Newton's method finds the moment. It is differentiated as it stands: its
        last iteration has the derivative of the implicit function. Where the propellant is gone before, the flight is
        continued by up to `SPARE` seconds, since only a cut-off has a derivative of the mass.
        """
        seconds, thrust, flow = (column[last, torch.arange(len(y))] for column in self.legs[0][:3])
        mu = self.rocket.mu
        controls = (*u.unbind(dim=-1), thrust, flow)
        longest = seconds + SPARE
        for _ in range(6):
            x = self.burn(y, u, seconds, thrust, flow).unbind(dim=-1)
            rx, ry, rz, vx, vy, vz, _ = x
            *_, ax, ay, az, _ = self.rates(x, controls)
            pull = mu * (rx * vx + ry * vy + rz * vz) / (rx * rx + ry * ry + rz * rz) ** 1.5
            power = vx * ax + vy * ay + vz * az + pull  # the energy's rate
            missing = self.rocket.target_energy - specific_energy(x, mu)
            seconds = torch.minimum((seconds + missing / power).clamp(min=0.0), longest)
        return self.burn(y, u, seconds, thrust, flow)

    def outcome(self, last, y, u):
        """What flights are judged by, (n, 7): the terminal error, and the mass in 100 kg. Arguments as for `end`."""
        end = self.end(last, y, u)
        h, e = (torch.stack(vector, dim=-1) for vector in orbit_vectors(end.unbind(dim=-1), self.rocket.mu))
        error = torch.cat([(h - self.h_target) / self.h_target.norm(), e - self.e_target], dim=-1)
        return torch.cat([error, end[:, 6:] / 100], dim=1)

    def to_eci(self, action, y):
        """The direction in ECI of an action (up, along-track, cross-track of the target's plane)."""
        up = F.normalize(y[..., :3], dim=-1)
        along = F.normalize(torch.linalg.cross(self.normal.expand_as(up), up), dim=-1)
        cross = torch.linalg.cross(up, along)
        return up * action[..., :1] + along * action[..., 1:2] + cross * action[..., 2:]


# ---------------------------------------------------------------------------------------------------------------------
# Flights
# ---------------------------------------------------------------------------------------------------------------------


class Flown(NamedTuple):
    """n flights as the environments flew them, T steps. After its end a flight repeats its last step."""

    y: torch.Tensor  # (T, n, 7) at the begins of the steps
    u: torch.Tensor  # (T, n, 3) directions in ECI
    shown: torch.Tensor  # (T, n, 3) what else was observed: mass, time and phase, which no steering changes
    last: torch.Tensor  # (n,) the step in which each ends
    crashed: bool  # whether any did


def fly(agent, env) -> Flown:
    """One flight of the mean action in each environment."""
    policy = agent.make_policy(env.episode_steps)
    obs, _ = env.reset()
    y, u, shown = [env.y.T.copy()], [], []
    last = np.zeros(env.num_envs, dtype=int)

    def record(step):
        y.append(env.y.T.copy())
        u.append(env.u.T)
        shown.append(step.obs[:, 6:9])
        last[step.flew] = step.t

    final = fly_until_ended(env, policy, obs, record)
    repeated = np.minimum(np.arange(len(u))[:, None], last), np.arange(env.num_envs)
    columns = (torch.tensor(np.array(column)[repeated]) for column in (y, u, shown))
    return Flown(*columns, torch.tensor(last), bool(final["crashed"].any()))


def directions(agent, physics: Physics, y, shown, memories: list):
    """The policy's directions (..., 3) in ECI, in states y (..., 7) with the other observations `shown` (..., 3).

    As `Agent.encode_step`, but nothing is written into a cache, which autograd could not follow. Each block's entry of
    `memories` is replaced: the keys and values of the last L steps, and two constants (`start_memories`).
    """
    obs = torch.cat([y[..., :6], shown], dim=-1)
    x = agent.encoder(ppo_gtrxl_rocket.features(agent, obs))
    for k, block in enumerate(agent.blocks):
        past, projections, R = memories[k]
        q, kv = block.attention.project(x, projections)
        window = torch.cat([past, kv], dim=3)
        x = block(x, block.attention.attend(q, window, R))
        memories[k] = window[:, :, :, 1:], projections, R
    return physics.to_eci(agent.get_mean_action(x + ppo_gtrxl_rocket.past_the_blocks(agent, obs)), y)


# ---------------------------------------------------------------------------------------------------------------------
# Their derivative
# ---------------------------------------------------------------------------------------------------------------------


def weights_of(agent) -> list:
    """The weights on which the mean action depends."""
    return [*agent.encoder.parameters(), *agent.blocks.parameters(), *agent.actor.parameters()]


def derivative(agent, env, flights: Flown):
    """`Physics.outcome` (n, 7) of flights that these environments flew, and its derivative (n, 7, W) by the weights."""
    physics = Physics(env, len(flights.y))
    return unrolled(agent, physics, flights) if agent.num_blocks else adjoint(agent, physics, flights)


def unrolled(agent, physics: Physics, flights: Flown):
    """`derivative` for any policy: fly once more in torch, step by step, and let autograd go back."""
    T, n = flights.y.shape[:2]
    states = [flights.y[0]]
    flown = []
    memories = start_memories(agent, n)
    for t in range(T):
        flown.append(directions(agent, physics, states[t], flights.shown[t], memories))
        states.append(physics.advance(np.array([t]), states[t][None], flown[t][None])[0])
    ends = flights.last, torch.arange(n)
    outcome = physics.outcome(flights.last, torch.stack(states)[ends], torch.stack(flown)[ends])
    return outcome.detach(), all_rows(outcome.flatten(), weights_of(agent), torch.eye(7 * n)).unflatten(0, (n, 7))


def all_rows(outputs, weights: list, rows):
    """The derivatives (R, W) of R weighted sums of the outputs; rows (R, *outputs.shape)."""
    parts = torch.autograd.grad(outputs, weights, rows, is_grads_batched=True)
    return torch.cat([part.flatten(start_dim=1) for part in parts], dim=1)


def start_memories(agent, n: int) -> list:
    """What `directions` remembers at the begin of a flight: a memory of zeros in each block."""
    zeros = agent.new_memory(n, noise=0.0)
    return [block.attention.start_cache(memory, 0) for block, memory in zip(agent.blocks, zeros)]


def adjoint(agent, physics: Physics, flights: Flown):
    """`derivative` for a policy without memory, in a tenth of the time: the method of adjoints.

    Once flown, the steps of all flights can be linearised at once instead of one by one:

        dy_{t+1} = A_t dy_t + B_t du_t,    du_t = K_t dy_t + what the weights change

    Backwards from the end, with G_t the outcome's derivative by y_t, a change of the direction in step t counts as
    g_t = G_{t+1} B_t, and G_t = G_{t+1} A_t + g_t K_t. For a flight that ends in step t, `outcome` gives both.
    """
    T, n = flights.y.shape[:2]
    y, u = flights.y.requires_grad_(), flights.u.requires_grad_()
    A, B = by_rows(physics.advance(np.arange(T), y, u), [y, u])
    (K,) = by_rows(directions(agent, physics, y, flights.shown, []), [y])
    ends = flights.last, torch.arange(n)
    y_last = y.detach()[ends].requires_grad_()
    u_last = u.detach()[ends].requires_grad_()
    outcome = physics.outcome(flights.last, y_last, u_last)
    by_y, by_u = by_rows(outcome, [y_last, u_last])

    G, g = torch.zeros_like(by_y), [by_u] * T
    for t in reversed(range(T)):
        ends_here = (flights.last == t)[:, None, None]
        g[t] = torch.where(ends_here, by_u, G @ B[t])
        G = torch.where(ends_here, by_y, G @ A[t]) + g[t] @ K[t]

    J, g = [], torch.stack(g)  # (T, n, 7, 3)
    for k in range(n):
        of_flight = directions(agent, physics, y[:, k].detach(), flights.shown[:, k], [])  # (T, 3)
        J.append(all_rows(of_flight, weights_of(agent), g[:, k].transpose(0, 1)))
    return outcome.detach(), torch.stack(J)


def by_rows(outputs, inputs: list) -> list:
    """The derivatives (..., outputs, inputs) of outputs (..., outputs) by each of some inputs (..., inputs).

    A row of outputs depends on the same row of the inputs alone, so that one sum serves all rows.
    """
    columns = []
    for k in range(outputs.shape[-1]):
        columns.append(torch.autograd.grad(outputs[..., k].sum(), inputs, retain_graph=True))
    return [torch.stack(column, dim=-2) for column in zip(*columns)]


# ---------------------------------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------------------------------

NEAR = 0.1  # of ||error||: from here on a policy is kept at the target while its mass grows
LONGEST = 0.05  # of a correction, in the weights' norm
MOMENTA = (0.9, 0.99)  # of Adam


@dataclass(frozen=True)
class Recipe:
    """How a policy is trained."""

    updates: int
    flights: int  # of an update
    learning_rate: float  # falls to a hundredth of it, as half a cosine
    damping: float = 1e-10  # of a correction, in parts of the trace: the smaller, the more of an error at once

    def rate(self, update: int) -> float:
        share = update / max(self.updates - 1, 1)
        return self.learning_rate * (0.01 + 0.99 * (1 + math.cos(math.pi * share)) / 2)


class Curve:
    """Twenty points of a training: flights and minutes of the processor until then, and what was measured."""

    def __init__(self):
        self.points = []
        self.flights = 0
        self.began = time.process_time()

    def add(self, recipe: Recipe, update: int, **measured):
        """Count an update. It is a point if it is a twentieth, or the last."""
        self.flights += recipe.flights
        if (update + 1) % max(recipe.updates // 20, 1) and update + 1 < recipe.updates:
            return
        minutes = (time.process_time() - self.began) / 60
        self.points.append({"flights": self.flights, "minutes": minutes} | measured)
        print(self.points[-1], flush=True)


def train_problem(agent, env, recipe: Recipe, curve: Curve):
    """Adam on the mean cost of flights from random starts."""
    optimizer = torch.optim.Adam(weights_of(agent), betas=MOMENTA)
    for update in range(recipe.updates):
        obs, _ = env.reset()
        cost = costs(agent, env.problem, torch.tensor(obs[:, : env.problem.states])).mean()
        optimizer.param_groups[0]["lr"] = recipe.rate(update)
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
        curve.add(recipe, update, cost_mean=cost.item())


def train_rocket(agent, env, recipe: Recipe, curve: Curve):
    """Train a rocket's policy towards the target first, and then towards more mass with the error kept at zero.

    n flights have 6 n errors that have to vanish, fewer than there are weights. Newton's step with the least change of
    the weights corrects the errors. Adam follows the gradient of the mean mass, without the part that would change an
    error. This is Rosen's gradient projection.
    """
    weights = weights_of(agent)
    theta = parameters_to_vector(weights).detach()  # (W,)
    before = theta.clone()
    optimizer = torch.optim.Adam([theta], betas=MOMENTA)
    for update in range(recipe.updates):
        flights = fly(agent, env)
        if flights.crashed:  # half of the last step is taken back: from the ground no derivative points to the orbit
            theta.lerp_(before, 0.5)
            vector_to_parameters(theta.clone(), weights)
            optimizer.state.clear()
            curve.add(recipe, update)
            continue
        outcome, J = derivative(agent, env, flights)
        error = outcome[:, :6]
        J_error = J[:, :6].flatten(0, 1)
        J_mass = J[:, 6].mean(dim=0)
        missed = error.norm(dim=1)  # (n,)
        is_near = missed.max() < NEAR

        products = J_error @ J_error.T  # (6 n, 6 n)
        damped = products + recipe.damping * products.trace() * torch.eye(len(products))

        def least_change(errors, J_error=J_error, damped=damped):
            """The smallest change of the weights (W,) that changes the errors (6 n,) by as much."""
            return J_error.T @ torch.linalg.solve(damped, errors)

        ascent = J_mass if is_near else -J_error.T @ (error / missed[:, None]).flatten()
        if is_near:
            ascent = ascent - least_change(J_error @ ascent)
        before = theta.clone()
        theta.grad = -ascent / ascent.norm().clamp(min=1.0)
        optimizer.param_groups[0]["lr"] = recipe.rate(update)
        optimizer.step()
        if is_near:
            step = theta - before
            correction = -least_change(error.flatten())
            correction = correction * (LONGEST / correction.norm()).clamp(max=1.0)
            theta.copy_(before + step - least_change(J_error @ step) + correction)
        vector_to_parameters(theta.clone(), weights)
        of_errors = {"error_median": missed.median().item(), "error_max": missed.max().item()}
        curve.add(recipe, update, **of_errors, mass_mean_kg=100 * outcome[:, 6].mean().item())


# ---------------------------------------------------------------------------------------------------------------------
# The rows of the table
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A training, the folder of results/ with PPO's policies for the same problem, and what the table has of both."""

    env_id: str
    result: str
    keys: tuple[str, ...]  # of the evaluation
    recipe: Recipe
    start: str = ""  # the row whose training comes first
    dispersion: float = 0.0
    has_memory: bool = False

    @property
    def script(self):
        """Ours: the network, and what it sees."""
        return script_of(self.env_id)


FOLDER = ROOT / "results" / "peers"  # of the runs' records
CUTOFF = "RocketAscentCutoff-v0"
NOMINAL = Recipe(updates=300, flights=1, learning_rate=2e-3)
SHORT = Recipe(updates=100, flights=1, learning_rate=2e-3)  # an update of the GTrXL takes ten times as long
CUTOFF_KEYS = ("error_norm", "final_mass_kg", "mass_ratio_reached")
ROWS = {
    "di": Row(
        env_id="DoubleIntegrator-v0",
        result="di",
        keys=("ratio_of_sums", "ratio_mean", "ratio_p95"),
        recipe=Recipe(updates=600, flights=256, learning_rate=3e-3),
    ),
    "cutoff": Row(CUTOFF, "rocket_cutoff", CUTOFF_KEYS, NOMINAL),
    "gtrxl": Row(CUTOFF, "rocket_cutoff", CUTOFF_KEYS, SHORT, has_memory=True),
    "dispersed": Row(
        env_id=CUTOFF,
        result="rocket_dispersed",
        keys=("dispersed_error_median", "dispersed_error_p95", "dispersed_mass_mean_kg"),
        recipe=Recipe(updates=120, flights=16, learning_rate=6e-4, damping=1e-8),
        start="cutoff",
        dispersion=1.0,
    ),
}


def make_envs(row: Row, n: int, seed: int):
    """n environments of a row, seeded, and their options."""
    args = row.script.Args(env_id=row.env_id)
    options = environment_options(row.script, args)
    if row.dispersion:
        options["dispersion"] = row.dispersion
    env = gym.make_vec(row.env_id, num_envs=n, **options).unwrapped
    env.reset(seed=seed)
    return env, options


def new_agent(row: Row, seed: int):
    """A script's agent, without blocks unless the row has a memory, and its arguments."""
    script = row.script
    args = row.script.Args(env_id=row.env_id, seed=seed)
    args = replace(args, **script.recipe(args))
    if not row.has_memory:
        args.num_blocks = 0
    torch.manual_seed(seed)
    return script.Agent(args, make_envs(row, 1, seed)[0]).double(), args


def train(name: str, seed: int, curve: Curve):
    """The trained agent of a row, and its arguments."""
    row = ROWS[name]
    agent, args = train(row.start, seed, curve) if row.start else new_agent(row, seed)
    if row.dispersion:
        args.dispersion = row.dispersion
        nominal, _ = make_envs(ROWS[row.start], 1, seed)
        row.script.fly_nominal(agent, agent.make_policy(nominal.episode_steps), nominal)
        with torch.no_grad():  # what a flight differs by from that one is a new input
            agent.encoder[0].weight[:, -len(row.script.DIFFERENCES) :] = 0.0
    env, _ = make_envs(row, row.recipe.flights, seed)
    (train_problem if name == "di" else train_rocket)(agent, env, row.recipe, curve)
    return agent, args


def evaluated(row: Row, agent) -> dict:
    """The metrics of the mean action in float32, on the flights on which every other row is evaluated."""
    task = task_of(row.env_id)
    env, options = make_envs(row, 1, 1)
    policy = agent.float().make_policy(env.episode_steps)
    n = task.default_flights(is_brief=False, **options)
    metrics, _ = evaluate.evaluate(row.env_id, policy, 0, n, **options)
    microseconds = decision_us(row.env_id, policy, **options)
    return metrics | task.reported_metrics(metrics, policy, **options) | {"decision_us": microseconds}


def policy_file(agent, args, curve: Curve, recipe: Recipe) -> bytes:
    """An agent.safetensors in the scripts' form, so that the scripts can fly it."""
    seconds = 60 * curve.points[-1]["minutes"]
    counters = {"seed": args.seed, "total_updates": recipe.updates, "global_step": 0}
    counters |= {"training_seconds": seconds, "wall_seconds": seconds}
    metadata = {"env_id": args.env_id, "args": json.dumps(plain_args(args)), **counters}
    return safetensors.torch.save(agent.float().state_dict(), {key: str(value) for key, value in metadata.items()})


# ---------------------------------------------------------------------------------------------------------------------
# Table and command
# ---------------------------------------------------------------------------------------------------------------------


def ppo_runs(row: Row) -> list[dict]:
    """The evaluations of our PPO's seeds on a row's problem, with the flights and minutes of each training.

    A dispersed training counts the one of the nominal flight with which each seed began, that of seed 1.
    """
    folder = ROOT / "results" / row.result
    flights = 0
    minutes = 0.0
    if row.start:
        nominal = ppo_runs(ROWS[row.start])[0]
        flights = nominal["flights"]
        minutes = nominal["minutes"]
    num_envs = read_checkpoint(folder / "agent.safetensors")["args"]["num_envs"]  # of all its seeds
    runs = []
    for path in sorted((folder / "seeds").glob("*.json")):
        run = read_json(path)
        run["flights"] = flights + run["total_updates"] * num_envs
        run["minutes"] = minutes + run["wall_seconds"] / 60
        runs.append(run)
    return runs


def table() -> list[list[str]]:
    """Lines of cells: of each row that has runs, and of our PPO's beneath it."""
    lines, keys = [], None
    for name, row in ROWS.items():
        records = [read_record(path) for path in sorted(FOLDER.glob(f"gradient_{name}_*.json"))]
        if not records:
            continue
        if row.keys != keys:
            keys = row.keys
            lines.append(["", "seeds", "flights", "minutes", *keys, "decision_us"])
        for title, runs in ((name, [last | final for last, final in records]), ("  our PPO", ppo_runs(row))):
            columns = [[run[key] for run in runs if key in run] for key in ("flights", "minutes", *keys, "decision_us")]
            lines.append([title, str(len(runs)), *map(cell, columns)])
    return lines


def parse_args():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("row", nargs="?", choices=ROWS, help="what to train; without it the table is printed alone")
    parser.add_argument("--seed", type=integer(1, 2**31 - 1), default=1)
    parser.add_argument("--save", type=output_file, help="where to write the policy, as the scripts do (.safetensors)")
    return parser.parse_args()


def main():
    options = parse_args()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    if options.row:
        code = provenance()  # now: minutes later it may be another
        row, curve = ROWS[options.row], Curve()
        agent, args = train(options.row, options.seed, curve)
        if options.save:
            write_bytes(options.save, policy_file(agent, args, curve, row.recipe))
        record = {**code, "weights": sum(weight.numel() for weight in weights_of(agent)), "curve": curve.points}
        record["final"] = evaluated(row, agent)
        write_json(FOLDER / f"gradient_{options.row}_{options.seed}.json", record)
    try:
        lines = table()
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    for line in lines:
        print(f"{line[0]:20}" + "  ".join(f"{word:24}" for word in line[1:]).rstrip())


if __name__ == "__main__":
    main()
