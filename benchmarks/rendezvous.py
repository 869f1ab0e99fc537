"""The rendezvous beside the published one: velocity change, accuracy and the cone, over the draws of an evaluation.

    python -m benchmarks.rendezvous results/rendezvous/agent.safetensors

A path may be that of any trained policy of `Rendezvous-v0`, also several. The optimum knows each draw in advance.
"""

from __future__ import annotations

import numpy as np

import envs
from benchmarks.policies import load
from common.command_line import OneLineParser, integer
from common.tables import lines_of
from common.tasks import task_of
from phased.metrics import KEPT
from phased.problem import flights_of_seed
from problems.rendezvous import GREATEST, RENDEZVOUS, impulse

ENV_ID = RENDEZVOUS.env_id
HEAD = ("", "nominal (m/s)", "draws: mean, σ (m/s)", "mean miss (m)", "within 0.5 m", "within 1 m", "cone kept")
PUBLISHED = (  # AIAA 2021-0668; of 1000 draws
    ("published: convex optimum", "4.877", "-", "-", "-", "-", "-"),
    ("published: PPO, 96 million steps, 10.8 hours", "5.431", "5.872, 1.236", "0.405", "76.2%", "99.6%", "100.0%"),
    ("published: behavioural cloning, 41 minutes", "4.994", "5.430, 1.125", "-", "52.1%", "100.0%", "0.0%"),
)


def velocity_change(flight: dict) -> np.ndarray:
    """The sum (n,) in m/s of a flight's impulses, with the one that stops the chaser at the end."""
    return GREATEST * np.linalg.norm(flight["u"], axis=2).sum(axis=1) + np.linalg.norm(flight["x"][:, -1, 3:], axis=1)


def row(name: str, nominal: dict, flights: dict) -> tuple[str, ...]:
    """The cells of the table: the velocity change without scatter, then of the drawn flights what HEAD names."""
    change = velocity_change(flights)
    miss = flights["terminal_error"][:, 0]
    kept = flights["constraint_max"] <= KEPT
    shares = [f"{np.mean(is_so):.1%}" for is_so in (miss <= 0.5, miss <= 1.0, kept)]
    alone = f"{velocity_change(nominal)[0]:.3f}"
    return name, alone, f"{change.mean():.3f}, {change.std():.3f}", f"{miss.mean():.3f}", *shares


def perfect_law(n: int = 1_000_000) -> tuple[str, ...]:
    """The row of a law without any error: it misses by what the last step draws, after the last impulse."""
    w = np.random.default_rng(0).uniform(-1, 1, (3, n)) * np.array(RENDEZVOUS.noise)[:, None]
    at_rest = (np.zeros(n),) * 6
    miss = np.linalg.norm(impulse(at_rest, (0, 0, 0), w)[:3], axis=0)
    shares = [f"{np.mean(miss <= 0.5):.2%}", f"{np.mean(miss <= 1.0):.1%}"]
    return "a perfect law", "-", "-", f"{miss.mean():.3f}", *shares, "-"


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+", metavar="POLICY", help="agent.safetensors of Rendezvous-v0")
    parser.add_argument("--draws", type=integer(1, 100_000), default=1000, metavar="N", help="default 1000")
    parser.add_argument("--eval-seed", type=integer(0, 2**32 - 1), default=0, metavar="S", help="default 0")
    args = parser.parse_args()
    task = task_of(ENV_ID)
    x0, draw = flights_of_seed(RENDEZVOUS, args.eval_seed, args.draws)
    best = task.solve_nominal(ENV_ID, RENDEZVOUS)
    rows = [HEAD, *PUBLISHED, row("optimum", best, task.optimum(args.eval_seed, args.draws))]
    for path in args.policies:
        agent, _, options = load(path)
        policy = agent.make_policy(RENDEZVOUS.steps)
        nominal = envs.fly(ENV_ID, policy, best["x"][:, 0], **options)
        rows.append(row(path, nominal, envs.fly(ENV_ID, policy, x0, draw, **options)))
    rows.append(perfect_law())
    print("\n".join(lines_of(rows)))


if __name__ == "__main__":
    main()
