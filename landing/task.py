"""The landers' family: its answers to what `common.tasks.Task` asks of an id."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.command_line import integer
from common.errors import refuse_unless
from common.tasks import SampledTask
from landing.comparison import compare
from landing.environment import fly_lander
from landing.lander import LANDERS, Lander
from landing.metrics import FLIGHTS, KEPT_FLIGHTS, REFERENCE_STARTS, draws, evaluate_policy
from landing.optimum import references
from landing.report import report_lander
from landing.table import table

INTERIM_FLIGHTS = 50  # flights of an evaluation during a training
BRIEF_FLIGHTS = 10  # flights of the reported evaluation after a training cut short
SOLVED = 20  # draws whose optima `baselines.py` solves unless --starts says otherwise


@dataclass(frozen=True)
class LanderTask(SampledTask):
    """A lander in `LANDERS`: every flight has its own draw."""

    env_id: str
    lander: Lander
    kept_flights = KEPT_FLIGHTS

    @classmethod
    def of(cls, env_id: str) -> LanderTask:
        return cls(env_id, LANDERS[env_id])

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, **env_options) -> dict:
        return {"draw": draws(eval_seed, n)}

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        """The optima of at most the first `REFERENCE_STARTS` draws, which know the draws, in periods of 0.2 s."""
        failure = {key: value for key, value in env_options.items() if key.startswith("failure_")}
        are_alike = self.lander.has_one_flight and not failure.get("failure_probability")
        z = draws(eval_seed, 1 if are_alike else min(n, REFERENCE_STARTS))
        solved = references(self.env_id, z, **failure)
        flown = fly_lander(self.env_id, held(solved["u"], self.lander), z, **failure)
        return flown | {key: solved[key] for key in ("solved", "fuel_kg", "final_time", "y")}

    def evaluate(self, policy, eval_seed: int, n: int, reference=None, **env_options):
        if reference is None:
            reference = self.optimum(eval_seed, n, **env_options)
        return evaluate_policy(self.env_id, policy, reference, eval_seed, n, **env_options)

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, **env_options) -> int:
        return BRIEF_FLIGHTS if is_brief else FLIGHTS

    def interim_flights(self, n: int, **env_options) -> int:
        return min(n, INTERIM_FLIGHTS)

    def remark_on_seed(self, eval_seed: int) -> str | None:
        return None  # draws of an evaluation come from another stream

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        return table(metrics)

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        return {
            "landed_rate": ("landed", ".2%"),
            "position_error_mean_m": ("position error, mean (m)", ".3f"),
            "position_error_max_m": ("position error, max (m)", ".3f"),
            "speed_mean_m_s": ("speed, mean (m/s)", ".3f"),
            "speed_max_m_s": ("speed, max (m/s)", ".3f"),
            "fuel_mean_kg": ("propellant, mean (kg)", ".1f"),
            "fuel_ratio": ("propellant / optimum's", ".4f"),
        }

    def progress_keys(self, **env_options) -> list[str]:
        return ["landed_rate", "position_error_mean_m", "speed_mean_m_s", "fuel_ratio"]

    def headline(self, metrics: dict) -> str:
        """A figure's title: how many flights landed, and with how much propellant."""
        landed = f"{metrics['landed_rate']:.2%} of {metrics['eval_starts']} flights landed"
        return f"{self.env_id}: {landed}, propellant {metrics['fuel_ratio']:.3f} x optimum"

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict:
        from drawing.training import Miss, training_figure
        from landing.figures import descent_figure, propellant_figure, touchdown_figure

        title = self.headline(metrics)
        figures = {}
        if curves:
            miss = Miss("eval/position_error_mean_m", "position error (m), mean action")
            figures["training.png"] = training_figure(curves, title, metrics["reference_episodic_return"], miss)
        figures["descent.png"] = descent_figure(arrays, title, self.lander)
        figures["touchdown.png"] = touchdown_figure(arrays, title)
        figures["propellant.png"] = propellant_figure(arrays, title)
        return figures

    def animation(self, arrays: dict, metrics: dict):
        from landing.animation import descent_animation

        return descent_animation(self.lander, arrays, self.headline(metrics))

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        of_flights = {"u", "decision_s", "start", "gravity", "effectiveness", "final_y", "final_t", "y", "fuel_kg"}
        return of_flights | {"y_reference", "fuel_kg_reference"}

    # --- commands

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        """The lander hovers in this case, with a thrust that carries its weight."""
        return [("", {}, [0.0, 0.0, self.lander.mass * self.lander.gravity / self.lander.greatest_thrust])]

    def add_arguments(self, parser) -> None:
        starts = integer(1, 10_000)
        about = f"draws (default {SOLVED})"
        parser.add_argument("--starts", type=starts, default=SOLVED, metavar="N", help=about)
        parser.add_argument("--seed", type=integer(0, 2**32 - 1), default=0, metavar="S", help="default 0")

    def baseline_command(self, args) -> tuple[dict, dict]:
        if self.lander.has_one_flight:
            allowed = f"must be left out: {self.env_id} has one start"
            refuse_unless(args.starts in (1, SOLVED), "--starts", args.starts, allowed)
            refuse_unless(args.seed == 0, "--seed", args.seed, allowed)
        return report_lander(self.env_id, args.starts, args.seed)

    def fly_opponents(self, folder, **options) -> None:
        compare(self.env_id, folder, **options)


def held(u: np.ndarray, lander: Lander):
    """The policy that flies the commands u (n, T, 3) in N, period by period.

    After a row's end it repeats the last command. A row without commands gives no thrust.
    """
    last = np.maximum(np.isfinite(u[:, :, 0]).sum(axis=1) - 1, 0)
    rows = np.arange(len(u))
    commands = np.nan_to_num(u) / lander.greatest_thrust
    return lambda obs, t: commands[rows, np.minimum(t, last)]
