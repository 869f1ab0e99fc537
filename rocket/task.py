"""The rocket's family: its answers to what `common.tasks.Task` asks of an id."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from common.command_line import integer, number
from common.errors import refuse_unless
from common.flying import decision_us
from rocket.any_orbit import REFERENCES, evaluate_targets, references, target_masses
from rocket.comparison import compare
from rocket.environment import flown_mission, fly_rocket
from rocket.failure import FAILURE_TIMES, LARGEST_FAILURE, NEEDS_CUTOFF
from rocket.metrics import (
    DISPERSED_STARTS,
    EQUATORIAL,
    SUCCESS,
    chosen,
    draws,
    evaluate_dispersed,
    failure_metrics,
    healthy,
    lowest_key,
    own_flight,
    perigee_longitude,
    rocket_metrics,
    savable_failures,
)
from rocket.missions import ROCKETS, Mission
from rocket.navigation import ALLOWED, NOMINAL_FLIGHT, flight_noise, is_noise, noise_metrics
from rocket.neighbours import compare_targets
from rocket.optimum import kept_reference, reached_optimum
from rocket.report import report_failures, report_rocket, report_targets
from rocket.rescue import Failing, known_optima
from rocket.table import table

INTERIM_STARTS = 100  # dispersed flights of an evaluation during a training


@dataclass(frozen=True)
class RocketTask:
    """A mission in `ROCKETS`: one nominal flight and, with the options `dispersion` and `failure`, many that differ."""

    env_id: str
    mission: Mission

    @classmethod
    def of(cls, env_id: str) -> RocketTask:
        return cls(env_id, ROCKETS[env_id])

    def flown_with(self, **env_options) -> RocketTask:
        """The same task with the environment's options `rocket` and `table_isp`."""
        changed = {name: env_options[name] for name in ("rocket", "table_isp") if name in env_options}
        return replace(self, mission=flown_mission(self.mission, **changed))

    # --- flying and measuring

    def reset_options(
        self, eval_seed: int, n: int, dispersion: float = 0.0, failure: float = 0.0, **env_options
    ) -> dict:
        if not dispersion and not failure:
            return {}
        return {"draw": draws(self.flown_with(**env_options).mission.rocket, dispersion, eval_seed, n, failure)}

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        """The optimum of the nominal flight, also with draws. It also finds the optima that evaluations need."""
        task = self.flown_with(**env_options)
        failing = Failing.of(env_options)
        if failing.failure:
            known_optima(self.env_id, task.mission, failing, eval_seed, n)
        if self.flies_many:
            target_masses(self.env_id, task.mission, eval_seed, references(n))
        return kept_reference(self.env_id, task.mission)

    def evaluate(
        self,
        policy,
        eval_seed: int,
        n: int,
        reference=None,
        dispersion: float = 0.0,
        failure: float = 0.0,
        failure_time: str = "random",
        **env_options,
    ):
        """Fly the nominal rocket once beside the optimum. With `dispersion` or `failure` also fly n that differ.

        Where flights have targets of their own, the nominal rocket also flies to n targets. In all other cases without
        draws seed and n are only noted. With the options `rocket` or `table_isp` the target and the optimum are
        those of that rocket. Metrics that are not finite (the apogee of a hyperbola) or have no meaning are left out.
        Returns the metrics of eval.json and the arrays of eval.npz.
        """
        if reference is None:
            reference = self.optimum(eval_seed, n, **env_options)
        task = self.flown_with(**env_options)
        noise = partial(flight_noise, eval_seed, [NOMINAL_FLIGHT])
        flight = fly_rocket(self.env_id, policy, noise=noise, **env_options)
        metrics = {"env_id": self.env_id, "eval_seed": eval_seed, "eval_starts": 1}
        metrics |= noise_metrics(env_options.get("navigation_noise"))
        metrics |= rocket_metrics(flight, reference, task.mission)
        arrays = {key: flight[key] for key in ("t", "u", "y", "reward")}
        arrays |= {f"{key}_reference": reference[key] for key in ("t", "u", "y")}
        if self.flies_many:
            found, ends = evaluate_targets(self.env_id, task.mission, policy, eval_seed, n, **env_options)
            own = {f"{key}_own": arrays.pop(key) for key in ("t", "u")}
            metrics, arrays = metrics | found, arrays | own | ends
        if dispersion or failure:
            failing = Failing(dispersion, failure, failure_time)
            of_healthy, ends = evaluate_dispersed(self.env_id, policy, eval_seed, n, **failing._asdict(), **env_options)
            metrics, arrays = metrics | of_healthy, arrays | ends
            if failure:
                known = known_optima(self.env_id, task.mission, failing, eval_seed, n)
                rocket = task.mission.rocket
                dry_mass = failing.vehicles(rocket, ends["draw"]).dry_mass
                metrics |= {"failure": float(failure), "failure_time": failure_time}
                metrics |= failure_metrics(ends, known.mass, known.mass_at(ends["final_error"], rocket), dry_mass)
                savable = savable_failures(ends, known.mass, dry_mass)
                arrays |= self.saved_flight(policy, ends, savable, eval_seed, **failing._asdict(), **env_options)
        return metrics, arrays

    def saved_flight(self, policy, arrays: dict, savable: np.ndarray, eval_seed: int, **env_options) -> dict:
        """Fly again, for the animation, the saved flight of the `savable` ones (n,) that burns longest.

        Returns `t_saved` (K+1,), `u_saved` (K, 3), `y_saved` (K+1, 7) and the flight's number `saved`. Without a saved
        flight it returns {}.
        """
        saved = savable & (np.linalg.norm(arrays["final_error"], axis=1) < SUCCESS)
        if not saved.any():
            return {}
        k = int(np.where(saved, arrays["final_t"], 0.0).argmax())
        noise = partial(flight_noise, eval_seed, [k])
        flight = fly_rocket(self.env_id, policy, draw=arrays["draw"][k], noise=noise, **env_options)
        return {f"{key}_saved": flight[key] for key in ("t", "u", "y")} | {"saved": np.array(k)}

    def reported_metrics(self, metrics: dict, timed_policy=None, **env_options) -> dict:
        """The mass beside the optimum's for the orbit that was reached. With draws also the time of a decision."""
        found = self.mass_reached(metrics)
        if has_draws(**env_options) and timed_policy is not None:
            found["decision_us"] = decision_us(self.env_id, timed_policy, **env_options)
        return found

    def mass_reached(self, metrics: dict) -> dict:
        """`mass_ratio_reached`: the final mass over `reference_mass_reached_kg`, the optimum's for the orbit reached.

        `mass_ratio` compares masses in two orbits, and an orbit a little off the target can be cheaper to reach. This
        ratio needs a solve of half a second and an orbit to solve for. So it is only for flights with cut-off and
        success. Without CasADi or a solution there is no key.
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

    @property
    def flies_many(self) -> bool:
        """Whether an evaluation flies many flights also without draws."""
        return self.mission.targets is not None

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, **env_options) -> int:
        if has_draws(**env_options) or self.flies_many:
            return INTERIM_STARTS if is_brief else DISPERSED_STARTS
        return 50 if is_brief else 1000  # only noted, because there is one start

    def interim_flights(self, n: int, **env_options) -> int:
        return min(n, INTERIM_STARTS) if has_draws(**env_options) or self.flies_many else n

    def remark_on_seed(self, eval_seed: int) -> str | None:
        return None  # draws of an evaluation come from another stream

    def refusal(
        self, trains: bool, observe_phase: bool = True, failure: float = 0.0, navigation_noise=None, **env_options
    ):
        if not is_noise(navigation_noise):
            return "navigation_noise", ALLOWED
        if failure and not self.mission.cutoff:
            return "failure", NEEDS_CUTOFF
        if failure and self.flies_many:
            return "failure", "must be 0 where flights have targets of their own"
        if has_draws(failure=failure, **env_options) and trains and not observe_phase:
            why = "not in a training with --dispersion or --failure: the nominal flight is looked up by the phase"
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
            "target_error_median": ("targets: ||error||, median", ".6f"),
            "target_error_p95": ("targets: ||error||, p95", ".6f"),
            "target_error_max": ("targets: ||error||, worst", ".6f"),
            "target_box_rate": ("targets: in the box", ".2%"),
            "target_mass_ratio_mean": ("targets: mass / optimum's, mean", ".5f"),
            "target_mass_ratio_min": ("targets: mass / optimum's, worst", ".5f"),
            "dispersed_error_median": ("dispersed: ||error||, median", ".6f"),
            "dispersed_error_p95": ("dispersed: ||error||, p95", ".6f"),
            "dispersed_perigee_error_mean_km": ("dispersed: perigee off, mean (km)", ".2f"),
            "dispersed_perigee_error_std_km": ("dispersed: perigee off, sigma (km)", ".2f"),
            "dispersed_box_rate": ("dispersed: in the box", ".1%"),
            "dispersed_mass_mean_kg": ("dispersed: final mass, mean (kg)", ".2f"),
            "failure_saved_rate": ("failures: saved of the savable", ".1%"),
            "failure_error_median": ("failures: ||error||, median", ".6f"),
            "failure_error_p95": ("failures: ||error||, p95", ".6f"),
            "failure_mass_short_mean_kg": ("failures: short of the optimum (kg)", ".2f"),
        }

    def progress_keys(self, dispersion: float = 0.0, failure: float = 0.0, **env_options) -> list[str]:
        dispersed = ["dispersed_error_median", "dispersed_error_p95", "dispersed_box_rate"]
        failed = ["failure_error_median", "failure_error_p95", "failure_saved_rate"]
        targets = ["target_error_median", "target_error_p95", "target_box_rate"]
        targets = targets if self.mission.targets is not None else []
        return ["error_norm", "mass_ratio", *targets, *(dispersed if dispersion else []), *(failed if failure else [])]

    def headline(self, metrics: dict) -> str:
        """A figure's title: error and mass."""
        crash = ", crashed" if metrics["crashed"] else ""
        best = f"optimum {metrics['reference_mass_kg']:.1f} kg"
        if "mass_ratio_reached" in metrics:
            best = f"optimum for the orbit reached {metrics['reference_mass_reached_kg']:.1f} kg"
        mass = f"final mass {metrics['final_mass_kg']:.1f} kg, {best}"
        return f"{self.env_id}: ||error|| {metrics['error_norm']:.6f}, {mass}{crash}"

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict:
        from drawing.training import Miss, training_figure
        from rocket.figures import ascent_figure, dispersed_figure, orbit_figure, targets_figure

        title = self.headline(metrics)
        arrays = own_flight(arrays)
        figures = {}
        if curves:
            label = "$\\Vert$error$\\Vert$ of the mean action"
            miss = Miss("eval/error_norm", label, success=SUCCESS, by_mean_action=True)
            figures["training.png"] = training_figure(curves, title, metrics["reference_episodic_return"], miss)
        highest = max(metrics["max_altitude_km"], metrics["reference_max_altitude_km"])
        figures["trajectory.png"] = ascent_figure(self.mission, arrays, title)
        figures["orbit.png"] = orbit_figure(self.mission, arrays, title, highest)
        if "dispersed_box_rate" in metrics:
            inside = f"{metrics['dispersed_box_rate']:.1%} of {metrics['dispersed_starts']} flights inside the box"
            title = f"{self.env_id} at dispersion {metrics['dispersion']:g}: {inside}"
            figures["dispersed.png"] = dispersed_figure(self.mission.rocket, flights_shown(arrays), title)
        if "target_starts" in metrics:
            figures["targets.png"] = targets_figure(self.mission.rocket, arrays, f"{self.env_id}: any orbit")
        return figures

    def animation(self, arrays: dict, metrics: dict):
        from rocket.animation import ascent_animation

        arrays = own_flight(arrays)
        if "saved" not in arrays:
            return ascent_animation(self.mission.rocket, arrays, self.headline(metrics))
        vehicle = Failing.of(metrics).vehicles(self.mission.rocket, arrays["draw"][arrays["saved"]][None])
        error = np.linalg.norm(arrays["final_error"][arrays["saved"]])
        title = f"{self.env_id}: a flight that loses thrust, ||error|| {error:.6f}, and the optimum without a loss"
        return ascent_animation(self.mission.rocket, arrays, title, vehicle)

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        names = {f"{key}{side}" for key in ("t", "u", "y") for side in ("", "_reference")} | {"reward"}
        if {"dispersion", "failure"} & metrics.keys():
            names |= {"draw", "final_y", "final_error"}
        if "target_starts" in metrics:
            names |= {"t_own", "u_own", "target", "final_y", "final_error", "best_mass"}
        return names | ({"failure"} if "failure" in metrics else set())

    def kept_arrays(self, arrays: dict) -> dict:
        return arrays

    # --- commands

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        """The rocket climbs in these cases, because with random actions it falls back to the pad in its first steps."""
        local = {"action_frame": "local"}
        return [("", local, [1.0, 0.3, 0.0]), (", dispersed", {**local, "dispersion": 1}, [1.0, 0.3, 0.0])]

    def add_arguments(self, parser) -> None:
        about = "what flights with failures up to this share of thrust can still reach, in place of the nominal optimum"
        parser.add_argument("--failure", type=number(0, LARGEST_FAILURE), default=0.0, metavar="K", help=about)
        parser.add_argument("--failure-time", choices=FAILURE_TIMES, default="random", help="default random")
        parser.add_argument("--dispersion", type=number(0, 10), default=0.0, metavar="D", help="of those flights")
        starts, at_first = integer(1, 100_000), self.flights_solved
        parser.add_argument("--starts", type=starts, default=at_first, metavar="N", help=f"of them: default {at_first}")
        parser.add_argument("--seed", type=integer(0, 2**31), default=0, metavar="S", help="of them: default 0")

    @property
    def flights_solved(self) -> int:
        """How many flights `baselines.py` solves by default, where there are many."""
        return REFERENCES if self.flies_many else DISPERSED_STARTS

    def baseline_command(self, args) -> tuple[dict, dict]:
        if self.flies_many:
            refuse_unless(
                not args.failure, "--failure", args.failure, "must be 0 where flights have targets of their own"
            )
            return report_targets(self.env_id, args.starts, args.seed)
        if not args.failure:
            unless_failing = {"dispersion": 0.0, "failure_time": "random", "starts": DISPERSED_STARTS, "seed": 0}
            for name, default in unless_failing.items():
                flag, value = f"--{name.replace('_', '-')}", getattr(args, name)
                refuse_unless(value == default, flag, value, "must be left out without --failure")
            return report_rocket(self.env_id)
        refuse_unless(self.mission.cutoff, "--failure", args.failure, NEEDS_CUTOFF)
        failing = Failing(args.dispersion, args.failure, args.failure_time)
        return report_failures(self.env_id, failing, args.starts, args.seed)

    def fly_opponents(self, folder, **options) -> None:
        if self.flies_many:
            names = ("n", "solved", "eval_seed", "also")
            compare_targets(self.env_id, folder, **{name: options[name] for name in names})
            return
        compare(self.env_id, folder, **options)


def has_draws(dispersion: float = 0.0, failure: float = 0.0, **env_options) -> bool:
    """Whether flights differ from one another with these options."""
    return bool(dispersion or failure)


def flights_shown(arrays: dict) -> dict[str, dict]:
    """What the figure of dispersed flights shows: {label: arrays}, with healthy and failed flights apart."""
    if "failure" not in arrays:
        return {"policy": arrays}
    ends = {key: arrays[key] for key in ("draw", "failure", "final_y", "final_error")}
    is_healthy = healthy(ends)
    shown = {"policy, healthy flights": is_healthy, "policy, flights with a failure": ~is_healthy}
    return {label: chosen(ends, flights) for label, flights in shown.items() if flights.any()}
