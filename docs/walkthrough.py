"""Run docs/walkthrough.md: write what its code prints into the page, and draw its pictures from its variables.

    python docs/walkthrough.py

Reading order: the page's code, its pictures.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

HERE = Path(__file__).resolve().parent
PAGE, ROOT = HERE / "walkthrough.md", HERE.parent
sys.path.insert(0, str(ROOT))
import envs  # noqa: E402
from rocket.metrics import altitude_km  # noqa: E402

STEP = re.compile(r"```python\n(.*?)```\n\n```text\n(.*?)```", re.DOTALL)  # code, and what it prints


# ------------------------------------------------------------------------------------------------- the page's code
def steps(page: str) -> list[tuple[str, str]]:
    """The steps of a page: code and what the page says that it prints."""
    return STEP.findall(page)


def run(codes) -> tuple[list[str], dict]:
    """Run codes one after the other in one namespace, from the repository's root: what each prints, and the namespace.

    `earlier_agent` is the agent before the last step, which makes another of that name.
    """
    printed, names = [], {}
    with contextlib.chdir(ROOT):
        for number, code in enumerate(codes, start=1):
            names["earlier_agent"] = names.get("agent")
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(code, f"step {number}", "exec"), names)
            printed.append(out.getvalue())
    return printed, names


def with_output(page: str, printed: list[str]) -> str:
    """The page with what its steps print now."""
    outputs = iter(printed)
    return STEP.sub(lambda step: f"```python\n{step[1]}```\n\n```text\n{next(outputs)}```", page)


# ------------------------------------------------------------------------------------------------- its pictures
def draw(folder, names):
    """Write the pictures into a folder, without version strings."""
    for name, figure in {"attention": draw_attention, "update": draw_update, "flight": draw_flight}.items():
        figure(names).savefig(Path(folder) / f"walkthrough_{name}.png", dpi=100, metadata={"Software": None})
    plt.close("all")


def draw_attention(names):
    """Steps 1 to 3, head 0: content scores, position scores, weights; grey is outside the window."""
    positions, scores, weights = (names[name][0, 0, 0].numpy() for name in ("positions", "scores", "weights"))
    positions = np.where(np.isinf(positions), np.nan, positions)
    panels = {
        r"content: $q_i\,k_j^T / \sqrt{d_k}$": scores - positions,
        r"position: $q_i\,R_{i-j}^T / \sqrt{d_k}$": positions,
        "weights: softmax of the sum": np.where(np.isnan(positions), np.nan, weights),
    }
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.7), layout="constrained", sharey=True)
    for ax, (title, values) in zip(axes, panels.items()):
        shares = "weights" in title
        low, high, colours = (0, 1, "Greens") if shares else (-3.5, 3.5, "RdBu_r")
        ax.imshow(values, vmin=low, vmax=high, cmap=plt.get_cmap(colours).with_extremes(bad="0.9"))
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                dark = value > 0.6 if shares else abs(value) > 2.2
                ax.text(j, i, f"{value:.2f}", ha="center", va="center", color="white" if dark else "black", fontsize=9)
        ax.set_xticks(range(7), ["m", "m", *range(5)])
        ax.set_yticks(range(5))
        ax.set(title=title, xlabel="key j (m: memory)")
    axes[0].set_ylabel("query i")
    return figure


@torch.no_grad()
def ratios(names):
    """The probability ratios (T, N) of the double integrator's batch under the agent after its update."""
    agent, batch = names["earlier_agent"], names["batch"]
    hidden = agent.encode(batch.obs.transpose(0, 1), batch.memory).transpose(0, 1)
    logprobs, *_ = agent.evaluate_actions(hidden, batch.actions)
    return (logprobs - batch.logprobs).exp().numpy()


def draw_update(names):
    """Steps 7 to 9: the sampled flights, the advantages along them, and how the update has moved the ratios."""
    from drawing.style import POLICY, TARGET

    batch = names["batch"]
    x = batch.obs[..., :2].numpy()
    advantages = batch.advantages.numpy()
    ratio = ratios(names)
    figure, axes = plt.subplots(1, 3, figsize=(9.3, 2.9), layout="constrained")
    axes[0].plot(x[:, :20, 0], x[:, :20, 1], color=POLICY["color"], linewidth=0.6, alpha=0.7)
    axes[0].plot(0, 0, "o", color=TARGET["color"])
    axes[0].set(title="20 of 80 sampled flights", xlabel="position $x_1$", ylabel="velocity $x_2$")
    t = 0.1 * np.arange(len(advantages))
    axes[1].plot(t, advantages[:, :20], color=POLICY["color"], linewidth=0.6, alpha=0.7)
    axes[1].set(title="their advantages, normalised", xlabel="time (s)", ylabel=r"$\hat A_t$")
    tenths = np.array_split(ratio.ravel()[advantages.ravel().argsort()], 10)
    axes[2].bar(range(1, 11), [100 * (tenth.mean() - 1) for tenth in tenths], color=POLICY["color"])
    axes[2].set(title="likelier after the update", ylabel="mean of $r_t - 1$ (%)")
    axes[2].set(xlabel=r"tenth of the actions by $\hat A_t$ (10: best)", xticks=range(1, 11))
    return figure


def draw_flight(names):
    """Step 10: altitude, pitch of the thrust, and the error of the orbit in the last seconds, beside the optimum's."""
    from drawing.style import BOUNDARY, OPTIMUM, POLICY

    rocket = envs.ROCKETS[names["args"].env_id].rocket
    flight = names["flight"]
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), layout="constrained")
    for side, label, style in (("", "policy", POLICY), ("_reference", "optimum", OPTIMUM)):
        t, u, y = (flight[key + side] for key in ("t", "u", "y"))
        up, *_ = envs.local_frame(y[:-1].T, envs.target_axes(rocket)[2])
        axes[0].plot(t, altitude_km(y, rocket), label=label, **style)
        axes[1].plot(t[:-1], np.degrees(np.arcsin((u.T * up).sum(axis=0))), **style)
        axes[2].semilogy(t - t[-1], np.linalg.norm(envs.terminal_error(y, rocket), axis=1), **style)
    for ax, title in zip(axes, ("altitude (km)", "pitch of the thrust (degrees)")):
        for burn in rocket.burns[:-1]:
            ax.axvline(burn.end, **BOUNDARY)
        ax.set(title=title, xlabel="time (s); dotted: staging")
    axes[0].legend(loc="lower right")
    axes[2].set(title="||error|| of the orbit so far", xlabel="time before the cut-off (s)", xlim=(-100, 3))
    return figure


if __name__ == "__main__":
    page = PAGE.read_text()
    printed, names = run([code for code, _ in steps(page)])
    PAGE.write_text(with_output(page, printed))
    draw(HERE, names)
