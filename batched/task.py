"""What is asked of an id without an optimum: see `common.tasks.Task`. Its tables and figures leave the optimum out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.batch import make_batch
from common.errors import BadInput
from common.flying import fly_until_ended
from common.tasks import SampledTask


@dataclass(frozen=True)
class BatchedTask(SampledTask):
    """An environment derived from `BatchedEnv`, measured over the episodes that a seed begins."""

    env_id: str

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        return {}

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, **env_options) -> dict:
        raise BadInput(f"env_id is {self.env_id!r}; it must be an id with an optimum: its starts have no table")

    def evaluate(self, policy, eval_seed: int, n: int, reference: dict | None = None, **env_options):
        """As `Task.evaluate`: the return, the length, and the mean of every number of `final_info`."""
        envs = make_batch(self.env_id, n, **env_options)
        T = envs.episode_steps
        obs, _ = envs.reset(seed=eval_seed)
        seen = np.full((n, T + 1, obs.shape[1]), np.nan)
        u = np.full((n, T, envs.single_action_space.shape[0]), np.nan)
        reward = np.zeros((n, T))
        seen[:, 0] = obs

        def record(step):
            u[step.flew, step.t] = step.action[step.flew]
            seen[step.flew, step.t + 1] = step.next_obs[step.flew]
            reward[step.flew, step.t] = step.reward[step.flew]

        final = fly_until_ended(envs, policy, obs, record, restart=True)
        metrics = {"env_id": self.env_id, "eval_seed": eval_seed, "eval_starts": n}
        metrics["episodic_return"] = float(reward.sum(axis=1).mean())
        metrics["episodic_length"] = float(np.isfinite(u[..., 0]).sum(axis=1).mean())
        for key, value in final.items():
            if value.ndim == 1 and value.dtype.kind in "fiub" and np.isfinite(value).all():
                metrics.setdefault(key if key.startswith("episodic_") else f"{key}_mean", float(value.mean()))
        return metrics, {"t": envs.dt * np.arange(T + 1), "obs": seen, "u": u, "reward": reward}

    # --- the size of an evaluation, and what a run may not do

    def refusal(self, trains: bool, **env_options) -> tuple[str, str] | None:
        try:
            make_batch(self.env_id, 1, **env_options)
        except BadInput as error:
            name = str(error).split()[0]  # every such message begins with its field
            return (f"no_{name}" if name in env_options else "env_id"), str(error)
        return None

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        lines = [
            f"{self.env_id}: {metrics['eval_starts']} episodes of eval seed {metrics['eval_seed']}, no optimum known"
        ]
        rows = {key: value for key, value in metrics.items() if key.startswith("episodic_") or key.endswith("_mean")}
        width = max(map(len, rows))
        return "\n".join([*lines, *(f"  {key:<{width}} {value:>12.4f}" for key, value in rows.items())])

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        return {"episodic_return": ("episodic return", ".4f"), "episodic_length": ("episodic length", ".1f")}

    def progress_keys(self, **env_options) -> list[str]:
        return ["episodic_return"]

    def headline(self, metrics: dict) -> str:
        """A figure's title."""
        return f"{self.env_id}: mean return {metrics['episodic_return']:.4g} ({metrics['eval_starts']} episodes)"

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict:
        from batched.figures import episodes_figure, training_figure

        figures = {"training.png": training_figure(curves, self.headline(metrics))} if curves else {}
        figures["episodes.png"] = episodes_figure(arrays, self.headline(metrics))
        return figures

    def animation(self, arrays: dict, metrics: dict):
        from batched.figures import episodes_animation

        return episodes_animation(arrays, self.headline(metrics))

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        return {"t", "obs", "u", "reward"}

    # --- commands

    def add_arguments(self, parser) -> None:
        """No flags: there is nothing to solve."""

    def baseline_command(self, args) -> tuple[dict, dict]:
        raise BadInput(
            f"env_id is {self.env_id!r}, without an optimum; it must be a table (`envs.Problem`) or a rocket"
        )
