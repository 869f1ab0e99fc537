"""What is asked of a rocket's id: see `common.tasks.Task`."""

from __future__ import annotations

from dataclasses import dataclass, replace

from common.errors import BadInput
from common.tasks import Interface
from formats.track import Track
from rocket import export
from rocket.comparison import compare
from rocket.environment import flown_mission, fly_rocket
from rocket.metrics import (
    DISPERSED_STARTS,
    EQUATORIAL,
    SUCCESS,
    decision_us,
    draws,
    evaluate_dispersed,
    lowest_key,
    perigee_longitude,
    rocket_metrics,
)
from rocket.missions import ROCKETS, Mission
from rocket.optimum import kept_reference, reached_optimum
from rocket.report import report_rocket
from rocket.table import table

INTERIM_STARTS = 100  # dispersed flights of an evaluation during a training


@dataclass(frozen=True)
class RocketTask:
    """A mission in `ROCKETS`: one nominal flight and, with the option `dispersion`, many that differ."""

    env_id: str
    mission: Mission

    @classmethod
    def of(cls, env_id: str) -> RocketTask:
        return cls(env_id, ROCKETS[env_id])

    def flown_with(self, **env_options) -> RocketTask:
        """As the options `rocket` and `table_isp` of the environment have it flown."""
        changed = {name: env_options[name] for name in ("rocket", "table_isp") if name in env_options}
        return replace(self, mission=flown_mission(self.mission, **changed))

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, dispersion: float = 0.0, **env_options) -> dict:
        if not dispersion:
            return {}
        return {"draw": draws(self.flown_with(**env_options).mission.rocket, dispersion, eval_seed, n)}

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        """The nominal flight's, whatever is drawn."""
        return kept_reference(self.env_id, self.flown_with(**env_options).mission)

    def evaluate(self, policy, eval_seed: int, n: int, reference=None, dispersion: float = 0.0, **env_options):
        """Fly the nominal rocket once beside the optimum's flight; with `dispersion` also n dispersed flights.

        Without it seed and n are only noted. With the options `rocket` or `table_isp` the target and the optimum are
        those of that rocket, too. Metrics that are not finite (the apogee of a hyperbola) or have no meaning are left
        out.
        """
        if reference is None:
            reference = self.optimum(eval_seed, n, **env_options)
        flight = fly_rocket(self.env_id, policy, **env_options)
        metrics = {"env_id": self.env_id, "eval_seed": eval_seed, "eval_starts": 1}
        metrics |= rocket_metrics(flight, reference, self.flown_with(**env_options).mission)
        arrays = {key: flight[key] for key in ("t", "u", "y", "reward")}
        arrays |= {f"{key}_reference": reference[key] for key in ("t", "u", "y")}
        if dispersion:
            of_all, ends = evaluate_dispersed(self.env_id, policy, eval_seed, n, dispersion, **env_options)
            metrics, arrays = metrics | of_all, arrays | ends
        return metrics, arrays

    def reported_metrics(self, metrics: dict, timed_policy=None, dispersion: float = 0.0, **env_options) -> dict:
        """The mass beside the optimum's for the orbit that was reached; of dispersed flights a decision's time."""
        found = self.mass_reached(metrics)
        if dispersion and timed_policy is not None:
            found["decision_us"] = decision_us(self.env_id, timed_policy, dispersion=dispersion, **env_options)
        return found

    def mass_reached(self, metrics: dict) -> dict:
        """`mass_ratio_reached`: the final mass over `reference_mass_reached_kg`, the optimum's for the orbit reached.

        `mass_ratio` compares two orbits: one a little off the target can be cheaper to reach. With cut-off and success
        only, for it takes a solve of half a second and an orbit to solve for; without CasADi or a solution, no key.
        """
        if not self.mission.cutoff or not metrics["success"]:
            return {}
        rocket, flight = self.mission.rocket, metrics
        if rocket.i in EQUATORIAL:  # the metric counts the perigee from the x axis, an element from the node
            flight = metrics | {"argp_deg": perigee_longitude(-metrics["raan_deg"], metrics["argp_deg"], rocket.i)}
        try:
            mass = float(reached_optimum(flight, rocket)["final_mass"])
        except (ImportError, RuntimeError):
            return {}
        return {"mass_ratio_reached": metrics["final_mass_kg"] / mass, "reference_mass_reached_kg": mass}

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, dispersion: float = 0.0, **env_options) -> int:
        if dispersion:
            return INTERIM_STARTS if is_brief else DISPERSED_STARTS
        return 50 if is_brief else 1000  # noted alone: there is one start

    def interim_flights(self, n: int, dispersion: float = 0.0, **env_options) -> int:
        return min(n, INTERIM_STARTS) if dispersion else n

    def remark_on_seed(self, eval_seed: int) -> str | None:
        return None  # draws of an evaluation come from another stream

    def refusal(self, trains: bool, dispersion: float = 0.0, observe_phase: bool = True, **env_options):
        if dispersion and trains and not observe_phase:
            why = "not in a training with --dispersion: the nominal flight is looked up by the phase"
            return "no_observe_phase", why
        return None

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        return table(metrics, self.mission)

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        return {
            "error_norm": ("||error||", ".6f"),
            "perigee_km": ("perigee (km)", ".2f"),
            "apogee_km": ("apogee (km)", ".2f"),
            "max_altitude_km": ("highest (km)", ".1f"),
            lowest_key(self.mission): ("lowest, late in the ascent (km)", ".1f"),
            "final_mass_kg": ("final mass (kg)", ".2f"),
            "mass_ratio": ("mass / optimum's", ".4f"),
            "mass_ratio_reached": ("mass / optimum's for the orbit reached", ".4f"),
            "dispersed_error_median": ("dispersed: ||error||, median", ".6f"),
            "dispersed_error_p95": ("dispersed: ||error||, p95", ".6f"),
            "dispersed_perigee_error_mean_km": ("dispersed: perigee off, mean (km)", ".2f"),
            "dispersed_perigee_error_std_km": ("dispersed: perigee off, sigma (km)", ".2f"),
            "dispersed_box_rate": ("dispersed: in the box", ".1%"),
            "dispersed_mass_mean_kg": ("dispersed: final mass, mean (kg)", ".2f"),
        }

    def progress_keys(self, dispersion: float = 0.0, **env_options) -> list[str]:
        dispersed = ["dispersed_error_median", "dispersed_error_p95", "dispersed_box_rate"]
        return ["error_norm", "mass_ratio", *(dispersed if dispersion else [])]

    def headline(self, metrics: dict) -> str:
        """A figure's title: error and mass."""
        crash = ", crashed" if metrics["crashed"] else ""
        best = f"optimum {metrics['reference_mass_kg']:.1f} kg"
        if "mass_ratio_reached" in metrics:
            best = f"optimum for the orbit reached {metrics['reference_mass_reached_kg']:.1f} kg"
        mass = f"final mass {metrics['final_mass_kg']:.1f} kg, {best}"
        return f"{self.env_id}: ||error|| {metrics['error_norm']:.6f}, {mass}{crash}"

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict:
        from rocket.figures import ascent_figure, dispersed_figure, orbit_figure

        title, figures = self.headline(metrics), {}
        if curves:
            figures["training.png"] = self.training_figure(metrics, curves)
        highest = max(metrics["max_altitude_km"], metrics["reference_max_altitude_km"])
        figures["trajectory.png"] = ascent_figure(self.mission, arrays, title)
        figures["orbit.png"] = orbit_figure(self.mission, arrays, title, highest)
        if "dispersion" in metrics:
            inside = f"{metrics['dispersed_box_rate']:.1%} of {metrics['dispersed_starts']} flights inside the box"
            title = f"{self.env_id} at dispersion {metrics['dispersion']:g}: {inside}"
            figures["dispersed.png"] = dispersed_figure(self.mission.rocket, {"policy": arrays}, title)
        return figures

    def training_figure(self, metrics: dict, curves: list[dict]):
        """The curves of a training, with the mean action's ||error||."""
        from drawing.training import Miss, training_figure

        label = "$\\Vert$error$\\Vert$ of the mean action"
        miss = Miss("eval/error_norm", label, success=SUCCESS, by_mean_action=True)
        return training_figure(curves, self.headline(metrics), metrics["reference_episodic_return"], miss)

    def animation(self, arrays: dict, metrics: dict):
        from rocket.animation import ascent_animation

        return ascent_animation(self.mission.rocket, arrays, self.headline(metrics))

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        names = {f"{key}{side}" for key in ("t", "u", "y") for side in ("", "_reference")} | {"reward"}
        return names | ({"draw", "final_y", "final_error"} if "dispersion" in metrics else set())

    def kept_arrays(self, arrays: dict) -> dict:
        return arrays

    # --- what is taken along

    def interface(self, **env_options) -> Interface:
        return export.interface(self.mission.rocket, **env_options)

    def step_columns(self, arrays: dict, launch_longitude: float) -> dict:
        return export.step_columns(self.mission.rocket, arrays, launch_longitude)

    def flight_columns(self, arrays: dict, metrics: dict) -> dict:
        if "dispersion" not in metrics:
            raise BadInput(f"the evaluation of {self.env_id} holds one flight; --flights needs one with --dispersion")
        return export.flight_columns(self.mission.rocket, arrays, metrics["dispersion"])

    def track(self, arrays: dict) -> Track:
        return export.earth_track(self.env_id, self.mission.rocket, arrays)

    # --- commands

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        """Climbing: steered at random it falls back to the pad in its first steps."""
        local = {"action_frame": "local"}
        return [("", local, [1.0, 0.3, 0.0]), (", dispersed", {**local, "dispersion": 1}, [1.0, 0.3, 0.0])]

    def add_arguments(self, parser) -> None:
        """There are none."""

    def baseline_command(self, args) -> tuple[dict, dict]:
        return report_rocket(self.env_id)

    def fly_opponents(self, folder, **options) -> None:
        compare(self.env_id, folder, **options)
