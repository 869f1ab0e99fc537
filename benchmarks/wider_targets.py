"""A policy that flies any orbit, beyond the range of its training, and where the vehicle's own edge is.

    python -m benchmarks.wider_targets results/rocket_any_orbit

Each row widens one number of the range and leaves the others as they were. It flies the same targets by the policy and
by IPOPT: how many have an optimum says what the vehicle can reach.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.policies import load
from common.command_line import OneLineParser, integer
from common.tables import lines_of
from common.tasks import task_of
from rocket.any_orbit import masses, solve_targets
from rocket.metrics import fly_batches, inside_box, targets_of

WIDER = {  # {row: what replaces the range's numbers}
    "as trained": {},
    "circular, 200 to 2000 km": {"perigee_km": (200.0, 2000.0), "apogee_km": (200.0, 2000.0)},
    "perigee 250 to 400 km": {"perigee_km": (250.0, 400.0), "apogee_km": (400.0, 36_000.0)},
    "apogee 36 000 to 80 000 km": {"apogee_km": (36_000.0, 80_000.0)},
    "inclination 40 to 50": {"i_deg": (40.0, 50.0)},
    "inclination 50 to 90": {"i_deg": (50.0, 90.0)},
    "inclination 90 to 120": {"i_deg": (90.0, 120.0)},
    "node 2 degrees aside": {"raan_deg": (-2.0, 2.0)},
    "perigee's place 6 to 20 degrees aside": {"argp_deg": (6.0, 20.0)},
}


def row(agent, env_id: str, options: dict, changes: dict, n: int) -> list[str]:
    """The cells of one range: optima found, then of those targets median, p95, worst and share in the box; mass."""
    mission = task_of(env_id).mission
    mission = replace(mission, targets=replace(mission.targets, **changes))
    targets = targets_of(mission, 0, n)
    best = masses(solve_targets(env_id, mission, targets))
    reachable = np.isfinite(best)
    cells = [f"{reachable.mean():.0%}"]
    if not reachable.any():
        return [*cells, "-", "-", "-", "-", "-"]
    ends = fly_batches(env_id, agent.make_policy(600), 0, {"target": targets[reachable]}, **options)
    errors = [f"{np.percentile(ends['error_norm'], p):.5f}" for p in (50, 95, 100)]
    good = ends["error_norm"] < 0.01
    mass = f"{(ends['final_mass_kg'] / best[reachable])[good].mean():.3%}" if good.any() else "-"
    return [*cells, *errors, f"{inside_box(ends, mission.rocket).mean():.1%}", mass]


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="results/<name> or runs/...")
    parser.add_argument(
        "--targets", type=integer(1, 100_000), default=100, metavar="N", help="of each row: default 100"
    )
    args = parser.parse_args()
    agent, trained, options = load(args.folder / "agent.safetensors")
    rows = [("", "reachable", "median", "p95", "worst", "in the box", "mass")]
    for name, changes in WIDER.items():
        rows.append((name, *row(agent, trained.env_id, options, changes, args.targets)))
    print("\n".join(lines_of(rows)))


if __name__ == "__main__":
    main()
