"""The small problems' family: its answers to what `common.tasks.Task` asks of an id. `baselines.py` solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.command_line import integer
from common.tasks import SampledTask
from phased.environment import fly
from phased.metrics import cost_ratio, flight_metrics, near_origin_metrics, ratio_metrics, say_what_is_beyond
from phased.problem import Problem, flights_of_seed
from phased.table import table

INTERIM_STARTS = 100  # of an evaluation during a training


@dataclass(frozen=True)
class PhasedTask(SampledTask):
    """A problem in `PROBLEMS`, measured over starts in its box."""

    env_id: str
    problem: Problem
    solve: Callable  # (env_id, problem, eval_seed, n) -> the optimum's flights from the n starts of a seed
    solve_nominal: Callable  # (env_id, problem) -> the optimum's flight without scatter
    report: Callable  # (env_id, starts, seed) -> the numbers and arrays of the printed optimum

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        return self.solve(self.env_id, self.problem, eval_seed, n)

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, **env_options) -> dict:
        x0, draw = flights_of_seed(self.problem, eval_seed, n)
        return {"x0": x0, "draw": draw} if self.problem.drawn else {"x0": x0}

    def evaluate(self, policy, eval_seed: int, n: int, reference: dict | None = None, **env_options):
        """As `Task.evaluate`. Raises ValueError if the reference belongs to other starts."""
        problem = self.problem
        x0, draw = flights_of_seed(problem, eval_seed, n)
        flight = fly(self.env_id, policy, x0, draw, **env_options)
        if reference is None:
            reference = self.optimum(eval_seed, n)
        if not np.array_equal(reference["x"][:, 0], x0):
            raise ValueError(f"reference does not belong to the {n} starts of eval_seed {eval_seed}")
        say_what_is_beyond(problem, flight["x"])
        compared = np.ones(n, dtype=bool)
        for side in (flight, reference):
            if problem.circles_count:
                compared &= side["hit"].all(axis=1)
            if problem.has_events:
                compared &= side["arrived"]
        costs = flight["cost"][compared], reference["cost"][compared]
        metrics = {"env_id": self.env_id, "eval_seed": eval_seed, "eval_starts": n}
        metrics |= flight_metrics(problem, flight, reference)
        if problem.has_events:
            metrics["compared_starts"] = int(compared.sum())
        metrics |= ratio_metrics(*costs, eval_seed)
        metrics |= near_origin_metrics(problem, x0[compared], *costs)
        if problem.noise:
            metrics |= self.evaluate_nominal(policy, **env_options)
        arrays = {"t": problem.dt * np.arange(problem.steps + 1)}
        arrays |= {key: flight[key] for key in ("x", "u", "reward", "cost")}
        arrays |= {f"{key}_reference": reference[key] for key in ("x", "u", "cost")}
        if problem.has_events:
            for key in ("final_time", "arrived"):
                arrays |= {key: flight[key], f"{key}_reference": reference[key]}
        if problem.drawn:
            arrays["draw"] = draw
        return metrics, arrays

    def evaluate_nominal(self, policy, **env_options) -> dict:
        """The cost ratio of the flight without scatter, or nothing if it misses a circle."""
        optimum = self.solve_nominal(self.env_id, self.problem)
        flight = fly(self.env_id, policy, optimum["x"][:, 0], **env_options)
        if not flight["hit"].all():
            return {}
        return {"nominal_ratio": float(cost_ratio(flight["cost"][0], optimum["cost"][0]))}

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, **env_options) -> int:
        if self.problem.has_one_flight:
            return 10
        return super().default_flights(is_brief)

    def interim_flights(self, n: int, **env_options) -> int:
        """Fewer where costs are functions: there an optimum takes IPOPT long, and each start's is solved first."""
        return n if self.problem.weighted else min(n, INTERIM_STARTS)

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        return table(self.problem, metrics)

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        rows = {
            "ratio_of_sums": ("ratio of sums", ".4f"),
            "ratio_mean": ("mean ratio", ".4f"),
            "ratio_median": ("median ratio", ".4f"),
            "ratio_p95": ("p95", ".4f"),
            "loss_near_origin_mean": ("mean loss near the origin", ".4f"),
            "arrival_rate": ("flights that arrive", ".1%"),
            "hit_rate": ("starts that hit every circle", ".1%"),
        }
        if not any(phase.has_circle for phase in self.problem.phases):
            del rows["hit_rate"]
        return rows

    def progress_keys(self, **env_options) -> list[str]:
        arrivals = ["arrival_rate"] if self.problem.has_events else []
        return ["ratio_of_sums", "ratio_p95", *arrivals]

    def headline(self, metrics: dict) -> str:
        """A figure's title: the problem and how close to the optimum the policy flies."""
        if "ratio_of_sums" not in metrics:
            shares = self.shares(metrics)
            return f"{self.env_id}: no cost ratio{', ' if shares else ''}{shares}"
        title = f"{self.env_id}: cost {metrics['ratio_of_sums']:.4f} x optimum"
        if self.problem.has_one_flight:
            return title
        if "arrival_rate" in metrics:
            counts = f"{metrics['compared_starts']} of {metrics['eval_starts']} starts"
            return f"{title} over {counts}: {self.shares(metrics)}"
        if self.problem.circles_count:
            return f"{title} over the starts that hit every circle ({metrics['hit_rate']:.1%})"
        return f"{title} ({metrics['eval_starts']} starts)"

    def shares(self, metrics: dict) -> str:
        """The shares of flights that arrive and of starts that hit, of a table that can miss them."""
        words = []
        if "arrival_rate" in metrics:
            words.append(f"{metrics['arrival_rate']:.1%} of the flights arrive")
        if self.problem.circles_count:
            words.append(f"{metrics['hit_rate']:.1%} of the starts hit every circle")
        return ", ".join(words)

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict:
        from drawing.training import Miss, training_figure
        from phased.figures import cost_error_figure, costs_figure, trajectories_figure

        problem = self.problem
        title = self.headline(metrics)
        figures = {}
        if curves:
            miss = Miss("eval/ratio_of_sums", "cost / optimum's, less 1, mean action", subtract=1.0)
            figures["training.png"] = training_figure(curves, title, metrics["reference_episodic_return"], miss)
        figures["trajectories.png"] = trajectories_figure(problem, arrays, title)
        if problem.has_one_flight:
            return figures
        figures["costs.png"] = costs_figure(problem, arrays, title)
        # with waypoints a missed circle would look like a gain
        if problem.states == 2 and problem.weighted and not problem.waypoints:
            figures["cost_error.png"] = cost_error_figure(problem, arrays, title)
        return figures

    def animation(self, arrays: dict, metrics: dict):
        from phased.animation import problem_animation

        return problem_animation(self.problem, arrays, self.headline(metrics))

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        return {"t", "x", "u", "reward", "cost", "x_reference", "u_reference", "cost_reference"}

    # --- commands

    def add_arguments(self, parser) -> None:
        parser.add_argument("--starts", type=integer(1, 100_000), default=1000, metavar="N", help="default 1000")
        parser.add_argument("--seed", type=integer(0, 2**32 - 1), default=0, metavar="S", help="default 0")

    def baseline_command(self, args) -> tuple[dict, dict]:
        return self.report(self.env_id, args.starts, args.seed)
